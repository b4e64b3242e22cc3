"""The publication's rivals, each as a small network of its own kind that learns from our takes.

Their official weights cannot be had everywhere, and learned from other pictures. These networks are written anew after
what is published of each kind, with fewer channels and steps, and learn from the very takes that teach the published
network (``quest bench comparison``). Their names end in ``-retrained``; those of official weights end in ``-official``.

:mod:`.windows` gives takes as windows of points whose way is known; :mod:`.objective` is what all of them learn by;
:mod:`.flow`, :mod:`.matcher` and :mod:`.refiner` are the networks; :mod:`.trackers` follow points through clips.
"""
