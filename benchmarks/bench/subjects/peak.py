"""What the core can do at most: a product of large square matrices by PyTorch: peak.py DTYPE."""

import sys

import torch
from turns import attend, rate

SIZE = 1024
torch.set_num_threads(1)
a, b = (torch.rand(SIZE, SIZE).to(getattr(torch, sys.argv[1])) for _ in range(2))
attend(lambda seconds: {"GFLOP/s": rate(lambda: torch.mm(a, b), seconds, 2 * SIZE**3 / 1e9)})
