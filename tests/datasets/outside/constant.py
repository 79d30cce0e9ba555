"""An estimator outside of the package, as a user's own is."""

import numpy as np

from gyro_pipeline.estimators.base import Estimator


class Constant(Estimator):
    """It says the same bias of every window, one more for each second after power-on."""

    recommended = True

    def __init__(self, bias=0.0, losses=None):
        self.bias, self.losses = bias, losses

    def _estimate(self, windows):
        return self.bias + windows.start_s[:, np.newaxis], 0.5
