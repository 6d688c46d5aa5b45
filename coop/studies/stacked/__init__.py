"""Many runs of Algorithm 1 on CartPole side by side, in PyTorch tensors on one device, with nothing on the host."""
