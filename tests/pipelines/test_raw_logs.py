import numpy as np
import pytest
import xarray as xr

from gyro_pipeline.conventions import DIMENSIONS, InputError
from gyro_pipeline.pipelines.raw_logs.nodes import label_recordings


@pytest.fixture
def files(make_recordings):
    return make_recordings(np.zeros((2, 3, 3)), samples=20, rate_hz=10, noise_dps_rts=0.1)


def test_dimensions_come_in_the_order_of_the_conventions(files):
    turned = files.transpose("sample", "axis", "imu", "recording")
    labelled = label_recordings(turned)
    assert labelled.angular_rate.dims == DIMENSIONS
    xr.testing.assert_identical(labelled, files)


def test_a_recording_that_is_absent_as_a_whole_is_kept_as_such(files):
    files.angular_rate[1, 2] = np.nan
    labelled = label_recordings(files)
    assert np.isnan(labelled.angular_rate[1, 2]).all()
    assert not np.isnan(labelled.angular_rate[0]).any()


@pytest.mark.parametrize("where", [(1, 2, 0, 7), (1, 2, 0), (1, 2, slice(0, 2))])
def test_a_recording_with_some_nan_is_refused(files, where):
    files.angular_rate[where] = np.nan
    with pytest.raises(InputError, match=r"sparkfun IMU 2 recording 3: expected finite samples"):
        label_recordings(files)
