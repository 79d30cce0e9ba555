"""A detector of rest: changes of the mean and raised noise, and how seldom it alarms."""

import numpy as np
from scipy import stats

from gyro_pipeline.quality.rest import RestDetector, student_limits

SIZE, SIGMA = 50, 0.05


def moments(rng, blocks, size=SIZE):
    """Means and variances of blocks of white noise, (block, 3)."""
    samples = rng.normal(0.4, SIGMA, (blocks, size, 3))
    return samples.mean(axis=1), samples.var(axis=1, ddof=1)


def detector(size=SIZE, false_alarm=1e-4, **options):
    return RestDetector(size, false_alarm, least_dps=0.02, **options)


def test_how_blocks_are_dealt_to_calls_changes_no_bit():
    rng = np.random.default_rng(1)
    means, variances = moments(rng, 300)
    means[200:, 1] += 0.1
    whole, parts = detector(), detector()
    expected = whole.update(means, variances)
    edges = [0, 1, 2, *np.sort(rng.choice(np.arange(3, 300), 40, replace=False)), 300]
    dealt = [
        parts.update(means[first:last], variances[first:last])
        for first, last in zip(edges[:-1], edges[1:], strict=True)
    ]
    for i in range(2):
        np.testing.assert_array_equal(np.vstack([part[i] for part in dealt]), expected[i])


def test_a_change_and_raised_noise_are_told_on_their_axis_and_at_once():
    means, variances = moments(np.random.default_rng(2), 120)
    means[60:, 1] -= 0.15
    variances[90:92, 2] *= 9
    moved, noisier = detector().update(means, variances)
    assert not moved[:, [0, 2]].any()
    assert not noisier[:, :2].any()
    assert 60 <= np.argmax(moved[:, 1]) <= 63
    assert 90 <= np.argmax(noisier[:, 2]) <= 91


def test_a_change_below_the_least_and_a_slow_drift_are_no_alarm():
    means, variances = moments(np.random.default_rng(4), 4000)
    means[200:, 0] += 0.02
    means[:, 2] += np.linspace(0, 1.5, 4000)
    assert not np.any(detector().update(means, variances))


def test_alarms_at_rest_are_no_more_frequent_than_asked_however_long_one_looks(size=5):
    rng = np.random.default_rng(5)
    alarms = [np.any(detector(size, 0.05).update(*moments(rng, 600, size))) for _ in range(120)]
    assert sum(alarms) <= 12  # of 6 expected at most


def test_limits_are_students_or_larger():
    normal = np.array([2.0, 4.0, 6.0])
    for freedom, most in ((3, 2), (10, 1.03), (100, 1.001)):
        ratio = student_limits(normal, freedom) / stats.t.isf(stats.norm.sf(normal), freedom)
        assert ratio.min() >= 1 - 1e-4
        assert ratio.max() <= most
