"""Temporal layers: each skeleton goes out once, on the key of its layer, and every receiver takes the layers its own
path carries (receiver-driven layered multicast; McCanne, Jacobson & Vetterli 1996).

The order is dyadic: layer 0 has every 8th skeleton, layer 1 the other 4ths, layer 2 the other 2nds, layer 3 the odd
ones, so that the lowest n layers are evenly spaced whatever n is. A packet repeats the frame before it, of whatever
layer. That is sound for every receiver: who takes all layers has what was lost, who takes all but the last one has the
whole motion, who takes fewer has two frames of each packet. Pure.
"""

from __future__ import annotations

LAYERS = 4


def layer_of(sequence: int) -> int:
    """The layer of the skeleton with that sequence number."""
    return max(0, LAYERS - 1 - ((sequence & -sequence).bit_length() - 1)) if sequence else 0


def divisor_of(layers: int) -> int:
    """Of the lowest ``layers`` (at least one) together: every so manieth skeleton is in them."""
    return 1 << (LAYERS - layers)


def between(first: int, last: int, layers: int) -> int:
    """How many sequence numbers after ``first`` and before ``last`` are in the lowest ``layers``."""
    divisor = divisor_of(layers)
    return max(0, (last - 1) // divisor - first // divisor)
