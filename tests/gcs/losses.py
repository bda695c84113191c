"""Chooses the packets that a link loses.

The contents of a packet and the number of earlier ones like it decide, never its time: a busy machine loses the same packets.
"""

import collections
import random


class Losses:
    """A fraction of the packets of every kind, chosen by a seed."""

    def __init__(self, fraction, seed):
        self.fraction = fraction
        self.seed = seed
        self.sent = collections.Counter()

    def takes(self, *packet):
        """Whether the next packet with these contents is lost."""
        said = repr(packet)
        self.sent[said] += 1
        return random.Random(f"{self.seed} {said} {self.sent[said]}").random() < self.fraction
