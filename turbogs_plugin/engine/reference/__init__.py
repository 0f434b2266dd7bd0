"""The torch engine: the definition of what every other one computes, and what runs without a GPU."""
