"""Training: the one loop with its checkpoints and losses, and what it learns from.

:func:`quest.train.loop.fit` is the loop. :mod:`quest.train.finding` is how the finder learns;
:func:`quest.train.dataset.open_dataset` prepares windows of takes for the published network.
"""
