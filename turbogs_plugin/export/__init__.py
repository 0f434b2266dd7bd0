"""What a run hands over: its model in the formats of other programs, one page with everything in it, and films."""
