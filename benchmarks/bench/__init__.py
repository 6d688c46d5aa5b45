"""`make bench`: coop beside what people would use instead, on the same work and cores, in turns."""
