"""A deterministic simulator of whole runs: the product's own objects in made-up time, with faults from a seed."""
