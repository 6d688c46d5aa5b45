"""What of a replay service is on disk: snapshots for epochs, the journal, and recovery from both."""
