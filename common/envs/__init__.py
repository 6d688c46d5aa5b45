"""Environments: one interface to ALE games, gymnasium environments and the built-in catch."""
