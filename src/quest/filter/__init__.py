"""The tracker's one posterior: how camera and bodies move, and which body carries each query.

Greyscale frames, depth and time stamps go in, places of queries come out. No network, no file, no command.
"""
