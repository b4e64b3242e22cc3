"""Free text selects among what the finder found: "the lever of the left door", "second drawer from the top"."""

from quest.text.choosing import Chosen, choose
from quest.text.meaning import Meaning, Which, understand

__all__ = ["Chosen", "Meaning", "Which", "choose", "understand"]
