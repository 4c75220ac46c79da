"""How far a model is to be trusted: quality, validation, direction, load, advice."""
