"""Which pixels of the chosen views are rendered."""
