import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.datasets.tables import Table


@pytest.fixture
def table(tmp_path):
    return Table(str(tmp_path / "new" / "bias.csv"))


def test_numbers_come_back_exactly(table):
    bits = np.random.default_rng(0).integers(0, 2**64, 20_000, dtype=np.uint64)
    values = bits.view(np.float64)
    values = np.append(values[~np.isnan(values)], [np.nan, 0.1, 5e-324, np.inf, -np.inf, -0.0])
    table.save(pd.DataFrame({"bias_dps": values}))
    back = table.load().bias_dps.to_numpy()
    np.testing.assert_array_equal(back.view(np.uint64)[:-6], values.view(np.uint64)[:-6])
    np.testing.assert_array_equal(back[-6:], values[-6:])
    assert np.signbit(back[-1])


def test_columns_keep_their_kinds_and_the_index_is_not_stored(table):
    data = pd.DataFrame(
        {"sensor": ["ng", "NA"], "imu": [1, 2], "real": [True, False], "bias_dps": [0.5, np.nan]},
        index=[7, 9],
    )
    table.save(data)
    pd.testing.assert_frame_equal(table.load(), data.reset_index(drop=True))
