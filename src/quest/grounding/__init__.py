"""Grounding: the joint that explains a 3D track."""

from quest.grounding.fit import fit_joint, joint_from_prior
from quest.grounding.joint import Joint, JointKind
from quest.grounding.online import JointEstimator
from quest.grounding.prior import JointPrior

__all__ = ["Joint", "JointEstimator", "JointKind", "JointPrior", "fit_joint", "joint_from_prior"]
