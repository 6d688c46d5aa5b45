"""The replay service's files: snapshots for checkpoints, the journal, and recovery from both."""
