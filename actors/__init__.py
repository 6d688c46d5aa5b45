"""The actor role: emulators, the epsilon-greedy policy and the assembly of segments."""
