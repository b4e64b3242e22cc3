"""The published method by itself: :mod:`network`, :mod:`matching`, :mod:`objective`, :mod:`flow`, :mod:`tracker`.

It shares with the rest of the house the image encoder, the losses and the training loop, and nothing of how our own
tracker follows entities. ``quest train --stage 1`` and ``--stage 2`` train it.
"""
