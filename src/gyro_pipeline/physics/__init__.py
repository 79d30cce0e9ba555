"""Models of stationary gyroscopes, their noise and their bias: NumPy and SciPy, deg/s, seconds."""
