"""The published methods, each named for its source."""
