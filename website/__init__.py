"""Builds the documentation's site from the pages in the repository (`make docs`)."""
