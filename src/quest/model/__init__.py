"""The networks: the finder and its parts, dense features, frames of the published network, and files of weights.

:class:`quest.model.finder.FinderNetwork` finds what can be taken hold of, :mod:`quest.model.found` reads its maps off,
:mod:`quest.model.weights` reads and writes trained networks.
"""
