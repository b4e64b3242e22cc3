"""Training: windows from prepared features, losses of stage 1, the loop, checkpoints, and the score that chooses.

:func:`quest.train.dataset.open_dataset` prepares windows, :func:`quest.train.loop.fit` is the one loop.
"""
