"""How far a model is to be trusted: the table of checks and its verdict, and what they ask."""
