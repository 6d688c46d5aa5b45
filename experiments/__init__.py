"""Wires the roles' own objects together in one process: lockstep runs, sweeps and reports."""

import common  # noqa: F401 (first: it answers a Ctrl-C while the rest is imported)
