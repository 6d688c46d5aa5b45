"""The replay service's files: snapshots for epochs, the journal, and recovery from both."""
