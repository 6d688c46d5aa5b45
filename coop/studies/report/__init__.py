"""Reports on a folder of runs: tables, figures and one page."""
