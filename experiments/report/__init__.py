"""What a folder of runs says: tables, figures and one page."""
