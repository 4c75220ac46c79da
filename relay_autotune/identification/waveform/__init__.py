"""The waveform fit: structures, responses with derivatives, least squares, covariance, choice."""
