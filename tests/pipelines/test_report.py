"""What the report says of recordings, and how its page is written."""

import base64
import re

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from kedro.io import DatasetError

from gyro_pipeline.datasets.reports import ReportFigure, ReportPage
from gyro_pipeline.markup import pipe_table
from gyro_pipeline.parameters import Only
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance, measure_noise
from gyro_pipeline.pipelines.reporting.nodes import write_report
from gyro_pipeline.pipelines.reporting.recordings import describe, drift, start_up

SENSORS = ("dot", "sparkfun", "ng")
WARM_UP_S, AMPLITUDE = 5.0, 0.02
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recordings(make_recordings):
    """Two IMUs of each sensor, ten recordings of which three test; DOT warms up by 20 mdps."""
    given = {}
    for seed, sensor in enumerate(SENSORS):
        bias = np.random.default_rng(seed).uniform(-1, 1, (2, 1, 3))
        bias = bias + np.random.default_rng(seed).normal(0, 1e-3, (2, 10, 3))
        made = make_recordings(bias, 600, 20.0, 0.004, seed, split=(5, 2, 3))
        made.attrs["sensor"] = sensor
        given[sensor] = made
    times_s = np.arange(600) / 20.0
    given["dot"]["angular_rate"] += np.float32(AMPLITUDE) * np.exp(-times_s / WARM_UP_S)
    return given


@pytest.fixture(scope="module")
def described(recordings, make_bias, make_quality, parameters):
    stored = {}
    for sensor, made in recordings.items():
        allan = measure_allan_variance(made)
        bias = make_bias(made, allan)
        quality = make_quality(made).assign(sensor=sensor, outcome="kept", findings=None)
        virtual = made.isel(imu=[0, 0, 0]).assign_coords(imu=[1, 2, 3])
        virtual = virtual.assign_attrs(train_recordings=6) if sensor == "sparkfun" else None
        given = made, bias, measure_noise(made, allan, bias), allan, quality
        tables = describe(*given, parameters().ground_truth, virtual)
        stored |= {f"{sensor}/{name}": (lambda t=table: t) for name, table in tables.items()}
    return stored


@pytest.fixture(scope="module")
def report(described, parameters):
    p = parameters("base")
    given = p.published, p.ground_truth, p.studies, {name: {} for name in p.sensors}
    return write_report("test", Only(), *given, described)


def test_drift_shows_a_warm_up_that_all_power_ons_share_and_none_where_there_is_none(recordings):
    (warm, warm_bounds), (still, bounds) = (drift(recordings[name]) for name in ("dot", "ng"))
    for axis in "xyz":
        own = warm[warm.line == axis]
        expected = AMPLITUDE * np.exp(-own.x / WARM_UP_S)
        expected -= expected[-round(len(own) / 4) :].mean()
        assert ((own.lo < expected) & (expected < own.hi)).mean() > 0.8
        assert own.y.iloc[0] == pytest.approx(expected.iloc[0], abs=4e-3)
        (fitted,) = [rows for name, rows in warm.groupby("line") if name.startswith(f"{axis},")]
        assert fitted.line.iloc[0].endswith("warm-up of 5 s")
        np.testing.assert_allclose(fitted.y, expected, atol=2e-3)
    assert AMPLITUDE < warm_bounds["warm_up_bound_dps_5"] < AMPLITUDE + 3e-3
    assert bounds["warm_up_bound_dps_5"] < 4e-3
    assert set(still.line) == set("xyz")  # no warm-up is drawn
    turned = recordings["dot"].copy(deep=True)  # other IMUs cannot hide that of the tested one
    turned.angular_rate[1:] *= -1
    assert drift(turned)[1] == warm_bounds
    still = still[still.line.isin(list("xyz"))]
    assert ((still.lo < 0) & (0 < still.hi)).mean() > 0.85
    alone, _ = drift(recordings["ng"].isel(imu=[0], recording=[0]))
    assert alone.lo.isna().all() and alone.y.notna().all()


def test_times_of_a_start_up_are_those_of_white_noise_with_and_without_history(recordings):
    made = recordings["ng"]
    noise = pd.DataFrame({"imu": 1, "axis": list("xyz"), "white_dps_rts": 0.004})
    noise = noise.assign(instability_dps=0.0, random_walk_dps_per_rts=0.0)
    means = made.angular_rate.mean("sample").to_dataframe("bias_dps").reset_index()
    row = start_up(made.assign(true_turn_on_spread=("axis", [2e-3] * 3)), means, noise)
    # (N / sigma)^2, and N^2 (1 / sigma^2 - 1 / tau^2)
    assert row["mean_s_at_1"] == pytest.approx(16, rel=0.01)
    assert row["ceiling_s_at_1"] == pytest.approx(16 * (1 - 1 / 4), rel=0.01)
    assert row["ceiling_s_at_1"] < row["history_s_at_1"] < row["mean_s_at_1"]
    assert row["mean_s_at_0.5"] == np.inf  # 64 s, of 30
    assert row["history_recordings"] == 7
    known = start_up(made.assign(true_turn_on_spread=("axis", [2e-4] * 3)), means, noise)
    assert known["ceiling_s_at_0.5"] == 0
    assert np.isnan(start_up(made, means, noise.assign(white_dps_rts=np.nan))["mean_s_at_1"])


def test_hours_are_counted_and_what_was_not_read_says_so(report):
    table = report[0]["dataset_hours"].set_index("Dataset")
    first, virtual = table.loc["1"], table.loc["3"]
    # training recordings of all six gyroscopes, test recordings of three, 30 s each
    assert (first["Training recordings"], first["Test recordings"]) == (6 * 7, 3 * 3)
    assert first["Train h"] == pytest.approx(6 * 7 * 30 / 3600, abs=0.0051)
    samples = (6 * 7 + 3 * 3) * 600
    ends = f"{samples / 145 / 3600:.2f} to {samples / 130 / 3600:.2f}"
    assert first["At the datasheet's rate h"] == ends
    assert (virtual["Training recordings"], virtual["Test recordings"]) == (9 * 6, 0)
    assert virtual["Source"].startswith("virtual, from test")
    assert table.loc["6", "Note"] == table.loc["4", "Note"] == "not made"


def test_datasheets_and_signals_are_shown_from_the_recordings(report, recordings):
    tables, figures, _ = report
    table = tables["sensor_specifications"].set_index("Sensor")
    sparkfun = table.loc["SparkFun"]
    assert sparkfun["Datasheet N mdps√s"] == pytest.approx(3.8 / np.sqrt(2))
    assert sparkfun["Datasheet σ mdps"] == pytest.approx(3.8 * np.sqrt(20 / 2))
    assert float(sparkfun["N mdps√s"].split()[0]) == pytest.approx(4, rel=0.1)
    assert float(sparkfun["σ mdps"].split()[0]) == pytest.approx(4 * np.sqrt(20), rel=0.03)
    assert table.loc["Memsense", "N mdps√s"] == "not read"
    assert tables["start_up"]["Sensor"].tolist() == ["Movella DOT", "SparkFun", "NG"]
    raw, calibrated = figures["calibrated_signal"].axes[0].lines[:2]
    samples = recordings["sparkfun"].angular_rate.isel(imu=0, recording=0, axis=0)
    np.testing.assert_allclose(raw.get_ydata(), samples, rtol=1e-6)
    assert np.mean(calibrated.get_ydata()) == pytest.approx(0, abs=1e-6)
    settled = [text.get_text() for text in figures["running_average"].legends[0].get_texts()]
    assert any(re.fullmatch(r"stays within from \d+\.\d s on", text) for text in settled)
    titles = [ax.get_title() for ax in figures["mg_convergence"].axes]
    assert [title.split()[0] for title in titles] == ["1", "4"]  # there are six
    allan = figures["allan_deviation"].axes[0]
    assert len(allan.lines) == 6 + 1 + 1  # each gyroscope, the fit, the datasheet
    assert "N = " in allan.texts[0].get_text()


def test_the_warm_up_that_a_published_gain_needs_is_in_the_answer(described, report, parameters):
    p = parameters("base")
    own = described["sparkfun/description"]()
    own[[f"white_dps_rts_{axis}" for axis in "xyz"]] = 0.0033
    own[[f"spread_dps_{axis}" for axis in "xyz"]] = 0.31e-3
    given = p.published, p.ground_truth, p.studies, {name: {} for name in p.sensors}
    page = write_report("test", Only(), *given, {"sparkfun/description": lambda: own})[2]
    # by hand: 0.52 of an amplitude of 30 s moves the mean of 10 s; 88 % needs it off by 3.4 mdps
    assert "(needed at power-on: SparkFun 2.8 to 9.1 thousandths of a deg/s, mdps, for" in page
    assert re.search(r"allow a warm-up of at most .*\d mdps .SparkFun", page)
    simulated = own.assign(simulated=True)
    page = write_report("test", Only(), *given, {"sparkfun/description": lambda: simulated})[2]
    assert "on measured data, bounds a warm-up" in page
    assert "(needed at power-on: SparkFun " in report[2] and "; NG " in report[2]


def test_the_page_needs_no_other_file_and_a_list_links_to_all_reports(tmp_path):
    page = ReportPage(str(tmp_path / "simulated" / "report.html"), str(tmp_path / "report.html"))
    figure = ReportFigure(str(tmp_path / "simulated" / "figures" / "<i>dot 3.png"))
    figure.save(plt.subplots()[0])
    evil = "<img src=x onerror=alert(1)> ![x](http://evil/x) [y](javascript:alert(1)) &lt; `c` *b*"
    table = pipe_table(pd.DataFrame({"File": [evil, "# _a_ | b"], "n": [1.25, np.nan]}))
    page.save(f"# A title\n\n## The answer\n\n{table}\n![a plot](figures/%3Ci%3Edot%203.png)\n")
    html = (tmp_path / "simulated" / "report.html").read_text()
    (picture,) = re.findall(r'src="([^"]*)"', html)
    stored = figure.load().read_bytes()
    assert base64.b64decode(picture.removeprefix("data:image/png;base64,")) == stored
    forbidden = r"<(script|link|iframe|i|em|code)>|@import|url\(|javascript:alert\(1\)\""
    assert not re.search(forbidden, html)
    assert "&lt;img src=x onerror=alert(1)&gt; ![x](http://evil/x) [y](javascript" in html
    assert "&amp;lt; `c` *b*</td>" in html and "# _a_ | b</td>" in html
    assert re.findall(r'href="([^"]*)"', html) == ["#the-answer"]
    for folder in ("only.sensor=dot", "../logs"):
        other = tmp_path / "simulated" / folder / "report.html"
        ReportPage(str(other), str(tmp_path / "report.html")).save("# Another\n")
    links = re.findall(r'href="([^"]*)"', (tmp_path / "report.html").read_text())
    names = ("logs", "simulated", "simulated/only.sensor=dot")
    assert links == [f"{name}/report.html" for name in names]
    with pytest.raises(DatasetError, match="no such picture"):
        page.save("# Second\n\n![x](figures/none.png)\n")
    assert (tmp_path / "simulated" / "report.html").read_text() == html  # nothing half written
