"""The settings of a run: fields, bounds, presets, schedules, and the flags that set them."""
