"""Scores on labelled real recordings: clips with labelled tracks, pictures with boxed handles."""
