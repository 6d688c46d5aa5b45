"""Lockstep on CartPole with loops that numba compiles (extra `fast`), one run or several side by side, to the bit as without."""
