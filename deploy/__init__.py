"""Starts and watches processes; never imports a role's code."""
