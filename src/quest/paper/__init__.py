"""The published method by itself: :mod:`network`, :mod:`matching`, :mod:`objective`, :mod:`tracker`, in this order.

It shares with the rest of the house the image encoder, the decoder's layers, the prepared frames, the losses and the
training loop, and nothing of how our own tracker follows entities. ``quest train --preset paper`` trains it.
"""
