"""Watching runs and sweeps, by their messages or by the files in their folders."""
