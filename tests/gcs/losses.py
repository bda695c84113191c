"""Which packets a link loses.

What a packet says and how often it went before decide, never the time at which it goes: a busy machine loses the same ones.
"""

import collections
import random


class Losses:
    """A share of the packets of every kind, chosen by a seed."""

    def __init__(self, share, seed):
        self.share = share
        self.seed = seed
        self.sent = collections.Counter()

    def takes(self, *packet):
        """Whether the next packet that says this is lost."""
        said = repr(packet)
        self.sent[said] += 1
        return random.Random(f"{self.seed} {said} {self.sent[said]}").random() < self.share
