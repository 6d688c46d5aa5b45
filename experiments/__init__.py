"""Wires the roles' own objects together in one process: lockstep runs, sweeps and reports."""
