"""Grounding: the joint that explains a 3D track, and the link that several tracks share."""

from quest.grounding.fit import fit_joint, joint_from_prior
from quest.grounding.joint import Joint, JointKind
from quest.grounding.online import JointEstimator
from quest.grounding.prior import JointPrior
from quest.grounding.shared import LinkGroups

__all__ = ["Joint", "JointEstimator", "JointKind", "JointPrior", "LinkGroups", "fit_joint", "joint_from_prior"]
