"""What a stationary gyroscope gives and what can be known from it: pure NumPy, deg/s, seconds."""
