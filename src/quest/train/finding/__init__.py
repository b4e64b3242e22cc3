"""How the finder learns: from labelled pictures and from takes."""
