"""Procedural furniture and appliances."""

from quest.sim.procedural.catalogue import CATEGORIES, MIXES, category_for_seed, make_object

__all__ = ["CATEGORIES", "MIXES", "category_for_seed", "make_object"]
