"""The network: image encoder, what a frame shows, queries and their decoder, heads, presets, and files of weights.

:class:`quest.model.network.QuestNetwork` assembles them, :mod:`quest.model.config` holds the presets,
:mod:`quest.model.weights` reads and writes trained networks.
"""
