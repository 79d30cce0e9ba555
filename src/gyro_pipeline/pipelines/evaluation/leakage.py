"""Nodes of the leak study's evaluation: errors in the windows that each leak calls its test."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import (
    ALL,
    AXES,
    BEST,
    BEST_EPOCH_ON_TEST,
    LAST,
    PAPER,
    RECORDING_MEAN,
)
from gyro_pipeline.estimators import Estimator
from gyro_pipeline.fingerprints import code_hash, fingerprint
from gyro_pipeline.learning.jobs import NetworkEstimator
from gyro_pipeline.parameters import Evaluation, Leakage, Splits
from gyro_pipeline.physics import allan as allan_module
from gyro_pipeline.physics import bias as bias_module
from gyro_pipeline.physics import ceiling
from gyro_pipeline.physics.ceiling import oracle
from gyro_pipeline.pipelines.evaluation import bench as bench_module
from gyro_pipeline.pipelines.evaluation import device as device_module
from gyro_pipeline.pipelines.evaluation.bench import Bench
from gyro_pipeline.pipelines.evaluation.device import describe_device
from gyro_pipeline.pipelines.evaluation.waiting import waiting
from gyro_pipeline.protocol import leaks, scores
from gyro_pipeline.protocol import truths as truths_module
from gyro_pipeline.protocol import windows as windows_module
from gyro_pipeline.protocol.leaks import (
    Division,
    divide_windows,
    strided_scores,
    used_recordings,
    with_windows,
)
from gyro_pipeline.protocol.scores import resampled_weights
from gyro_pipeline.protocol.windows import cut_windows
from gyro_pipeline.tracking import (
    CURVE,
    ERRORS,
    EVALUATED_WITH,
    WEIGHTS,
    EvaluatedRun,
    StoredRun,
)

_CODE = (
    allan_module,
    bias_module,
    ceiling,
    bench_module,
    device_module,
    leaks,
    scores,
    truths_module,
    windows_module,
)


def evaluate_leakage(  # noqa: PLR0917 - a node's arguments are its datasets
    cells: pd.DataFrame,
    runs: list[StoredRun],
    recordings: xr.Dataset,
    bias: pd.DataFrame,
    allan: xr.Dataset,
    leakage: Leakage,
    splits: Splits,
    evaluation: Evaluation,
) -> Iterator[EvaluatedRun]:
    """Judge every run of the leak study that was not judged this way before.

    Args:
        cells: The plan.
        runs: The study's trained runs on this sensor.
        recordings: Real recordings.
        bias: Their ground truth.
        allan: Their Allan variances.
        leakage: Its recordings and window.
        splits: The seed of the deal.
        evaluation: Resamples and seed of the intervals.

    Yields:
        Metrics, those of the network named ``..._strided``, and the errors of every test window.
        The check against the oracle is not among them: a leak is meant to beat it.
    """
    judged_with = fingerprint([code_hash(_CODE), evaluation.model_dump()])
    recordings = with_windows(recordings, leakage)
    numbers = tuple(used_recordings(recordings, leakage))
    device = describe_device(recordings, bias, allan, numbers, evaluation.bootstrap_seed)
    bench = Bench(recordings, device, numbers, leakage.window_s, evaluation)
    label = f"leakage {recordings.attrs['sensor']}"
    for cell, run in waiting(cells, runs, judged_with, label):
        place = (cell["leak"], cell["fold"], cell["window_stride_s"])
        divided = divide_windows(*place, recordings, leakage, splits.split_seed)
        yield _judged(run, bench, divided, judged_with)


def _judged(run: StoredRun, bench: Bench, divided: Division, judged_with: str) -> EvaluatedRun:
    which = BEST if run.params["leak"] == BEST_EPOCH_ON_TEST else LAST
    errors = strided_error_table(NetworkEstimator(run.load(WEIGHTS), which), bench, divided)
    curve = bench.curve[(bench.curve.truth == PAPER) & (bench.curve.windows == ALL)]
    evaluation = bench.evaluation
    resampled = resampled_weights(
        errors.recording.nunique(), evaluation.resamples, evaluation.bootstrap_seed
    )
    scored = strided_scores(errors, curve, bench.window_s, resampled)
    scored = {f"{base}_strided": estimate for base, estimate in scored.items()}
    metrics = {
        name: value
        for base, estimate in (scored | bench.ceilings(PAPER, ALL)).items()
        for name, value in (
            (base, estimate.value),
            (f"{base}_lo", estimate.lo),
            (f"{base}_hi", estimate.hi),
        )
        if value is not None and np.isfinite(value)
    }
    tags = {EVALUATED_WITH: judged_with, "ceiling": bench.ceiling_basis}
    return EvaluatedRun(run.run_id, metrics, tags, {ERRORS: errors, CURVE: curve})


def strided_error_table(estimator: Estimator, bench: Bench, divided: Division) -> pd.DataFrame:
    """Errors in the test windows against truth (a), of the network and of what it is held against.

    Args:
        estimator: The network.
        bench: The recordings that the study uses.
        divided: Which of their windows train and test.

    Returns:
        A row per window and axis: ``recording``, ``start`` (sample), ``axis``, ``error_dps``,
        ``mean_error_dps`` of the running mean, ``constant_error_dps`` of the mean of the training
        labels, and ``oracle_error_dps`` on simulated white noise.
    """
    biases = {one.number: one.mean for one in bench.tested}
    labels = np.array([biases[number] for number in divided.training])
    windows = [len(starts) for starts in divided.training.values()]
    constant = np.average(labels, axis=0, weights=windows)
    device, tables = bench.device, []
    for one in bench.tested:
        if one.number not in divided.test:
            continue
        starts = one.starts(bench.size, divided.test[one.number])
        means = one.window_means(bench.size, starts)
        seen = cut_windows(one.samples, bench.size, starts).transpose(1, 0, 2)
        estimated, _ = estimator.estimate(seen, RECORDING_MEAN)
        estimates = {"": estimated, "mean_": means, "constant_": constant}
        if device.unit_bias is not None and device.models is None:
            known = (device.unit_bias, device.spread[0], device.noise[0])
            estimates["oracle_"] = oracle(means, *known, bench.window_s, bench.recording_s, PAPER)
        of = {"recording": one.number, "start": np.repeat(starts, len(AXES))}
        errors = {
            f"{name}error_dps": np.ravel(estimate - biases[one.number] + 0 * means)
            for name, estimate in estimates.items()
        }
        tables.append(pd.DataFrame(of | {"axis": np.tile(AXES, len(starts))} | errors))
    return pd.concat(tables, ignore_index=True)
