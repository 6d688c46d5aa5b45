"""The replay table: exact capacity, each frame stored once, policies of eviction and sampling."""
