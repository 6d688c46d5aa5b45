"""Algorithm 1 in one process, with the roles' own objects."""
