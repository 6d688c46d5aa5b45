"""The replay table: exact capacity, each frame stored once, eviction and sampling policies."""
