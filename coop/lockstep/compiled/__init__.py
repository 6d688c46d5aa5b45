"""Lockstep on CartPole in loops that numba compiles (extra `fast`): one run or several, to the bit as without."""
