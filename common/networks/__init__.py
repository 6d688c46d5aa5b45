"""Q-networks over one flat parameter vector."""
