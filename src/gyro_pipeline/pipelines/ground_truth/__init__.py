"""Ground truth: the bias of every recording, and the noise of every gyroscope."""
