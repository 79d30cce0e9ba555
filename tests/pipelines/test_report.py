"""What the report says, from small tables with known numbers; and how it is written."""

import base64
import re

import matplotlib.pyplot as plt
import pandas as pd
import pytest
from kedro.io import DatasetError

from gyro_pipeline.conventions import Missing
from gyro_pipeline.datasets.report_page import ReportFolder, ReportPage
from gyro_pipeline.datasets.reports import ReportFigure, ReportTable
from gyro_pipeline.parameters import Only
from gyro_pipeline.pipelines.reporting.captions import CAPTIONS
from gyro_pipeline.pipelines.reporting.pipeline import create_pipeline
from gyro_pipeline.pipelines.reporting.report import write_report
from gyro_pipeline.tracking import SCORES, StoredRun

THREE = "tables/augmentation_three_gyroscopes"
COMMAND = "kedro run --pipeline=augmentation --params=only.sensor=dot"
TABLE = pd.DataFrame({"Approach": ["<b>Real2Real</b>"], "A %": ["51 [40, 60]"], "Runs": ["run0"]})


def stored(number, estimator="cnn", simulated="1", oracle_p=0.5, **tags):
    given = {
        "kedro_env": "smoke",
        "mlflow.source.git.commit": "0123456789abcdef",
        "git_dirty": "True",
        "gyro-pipeline": "0.1.0",
        "torch": "2.13.0",
        "simulated": simulated,
        "fingerprint": f"fingerprint{number}",
    }
    params = {"estimator": estimator, "sensor": "sparkfun", "seed": "0", "window_s": "10.0"}
    names = ["weights", "truth", "windows", "score", "value", "lo", "hi"]
    oracle = ("last", "paper", "all", "beats_oracle_p", oracle_p, None, None)
    scores = pd.DataFrame([oracle] if estimator == "cnn" else [], columns=names)
    return StoredRun(
        run_id=f"run{number}",
        experiment_id="7",
        study="augmentation",
        finished=True,
        trained=True,
        started_ms=1_700_000_000_000,
        params=params | {"epochs": "1200"},
        tags=given | tags,
        metrics={},
        fits=frozenset(),
        load={SCORES: scores}.__getitem__,
        load_fit={}.__getitem__,
    )


def result(number, gain, **changes):
    """A row over 10 s, where the mean errs by 1 mdps and the ceiling lies at 0.43."""
    rmse = 1e-3 * (1 - gain / 100)
    row = {
        "sensor": "sparkfun", "estimator": "cnn", "method": 2, "real_gyros": 3, "window_s": 10.0,
        "virtual_gyros": 0, "missing": None, "run_ids": f"run{number}", "simulated": True,
        "test_rmse_dps_all": rmse, "mean_rmse_dps_all": 1e-3, "ceiling_rmse_dps_all": 0.43e-3,
        "accuracy_gain_pct_all": gain, "accuracy_gain_pct_all_lo": gain - 10,
        "accuracy_gain_pct_all_hi": gain + 10, "ceiling_accuracy_gain_pct_all": 57.0,
        "ceiling_accuracy_gain_pct_all_hi": None, "recording_s": 86.5,
    }  # fmt: skip
    return row | changes


@pytest.fixture
def rows():
    """The mean, and networks with 0 and 24 virtual gyroscopes."""
    return [
        result(0, 0.0, estimator="mean"),
        result(1, 50.0),
        result(2, 54.0, virtual_gyros=24),
    ]


@pytest.fixture
def write(parameters, rows):
    """The report's content on these rows, with anything changed."""

    def make(source="simulated", only=None, folder=None, runs=None, **made):
        base = parameters("base")
        sensors = {name: sensor.model_dump() for name, sensor in base.sensors.items()}
        claims = [row for row in base.published.results if row.sensor == "sparkfun"]
        published = base.published.model_copy(update={"results": claims})
        start = "augmentation.reporting."
        none = pd.DataFrame(columns=["source", "run_ids"])
        given = {
            f"{start}results": pd.DataFrame(rows),
            f"{start}measured_elsewhere": none,
            f"{start}all_runs": runs or [stored(0, "mean"), stored(1), stored(2)],
            f"{start}tables.three_gyroscopes": TABLE,
            f"{start}gaps.three_gyroscopes": (),
        }
        given |= {name if "." in name else f"{start}{name}": part for name, part in made.items()}
        return write_report(source, only or Only(), sensors, published, folder or {}, **given)

    return make


def item(content, kind, title):
    (found,) = [one for one in content[kind] if one["title"] == title]
    return found


def sentence(content, words):
    (found,) = [one for one in content["findings"] if words in one]
    return found


# what is said


def test_every_table_and_figure_of_the_paper_has_a_caption():
    studies = ("augmentation", "real2real", "input_channels", "estimators", "unseen_devices")
    asked = {"sensors": ["sparkfun"], "inspected": ["sparkfun"]}
    sensors = ["sparkfun", "dot", "ng", "memsense"]
    made = create_pipeline(dict.fromkeys(studies, sensors), **asked).all_outputs()
    places = {
        f"{kind}/{study.replace('.', '_')}{name}"
        for study, _, rest in (address.partition("reporting.") for address in made)
        for kind, _, name in [rest.partition(".")]
        if kind in ("tables", "figures") and name not in ("results", "comparison")  # long
    }
    assert places == CAPTIONS.keys()


def test_it_says_what_was_run(write):
    content, _ = write()
    facts = dict(content["facts"])
    assert facts["Data"].startswith("Simulated recordings (source `simulated`)")
    # 80 recordings of 12 gyroscopes and 20 of 3, of 87 s: the paper's 24.65 h
    assert facts["Recordings"].startswith("24.6 h")
    assert facts["Networks"] == "2 trained, of 1200 epochs (the paper: 1200)"
    assert facts["Code"].startswith("commit `0123456789ab` with uncommitted changes")
    assert facts["Trained"].startswith("2023-11-14 22:13")
    assert (facts["Seeds"], facts["Windows"], facts["Environment"]) == ("0", "10 s", "`smoke`")
    assert content["simulated"] and not content["smoke"]
    assert write("simulated_smoke")[0]["smoke"]


def test_of_a_study_without_networks_it_says_how_many_estimators(write, rows):
    rows[1:] = [result(1, 60.0, estimator="best_linear")]
    content, _ = write(runs=[stored(0, "mean"), stored(1, "best_linear")])
    facts = dict(content["facts"])
    assert facts["Estimators"] == "1 besides the mean and the network, windows of 10 s"
    assert not {"Networks", "Seeds", "Windows"} & set(facts)
    labels = [row["label"] for study in content["studies"] for row in study["rows"]]
    assert labels == ["sparkfun, running mean, 10 s", "sparkfun, best_linear, 10 s: A 60 %"]
    assert content["comparison"].empty


def test_measured_recordings_are_called_so_and_nothing_is_said_of_a_constant(write, rows):
    rows[:] = [row | {"simulated": False} for row in rows]
    content, _ = write("published", runs=[stored(number, simulated="0") for number in range(3)])
    facts = dict(content["facts"])
    assert facts["Data"].startswith("Recordings measured on real sensors")
    assert facts["Recordings"] == "sparkfun: 86.5 s each"
    assert not content["simulated"]
    assert not [one for one in content["findings"] if "constant" in one]
    assert content["comparison"]["Constant, expected"].isna().all()


def test_results_on_measured_data_of_another_source_are_named(write):
    elsewhere = pd.DataFrame([result(9, 10.0, source="published")])
    runs = [stored(0, "mean"), stored(1), stored(2), stored(9, simulated="0")]
    content, _ = write(runs=runs, measured_elsewhere=elsewhere)
    assert dict(content["facts"])["Beside them"].endswith("recordings of published")
    assert content["simulated"]
    labels = [row["label"] for row in content["studies"][0]["rows"]]
    assert labels[-1] == "sparkfun, 3 real, 10 s: A 10 % (published)"


def test_findings_are_counted(write):
    content, _ = write()
    # 72/57 is within 1 - sqrt(10 / 87) = 66 %, the other four are beyond
    limit = sentence(content, "exceed the limit")
    assert limit.startswith("4 of 5 published results exceed")
    assert "with T = 87 s on sparkfun. It holds" in limit
    # of 57 and 79, the ceiling is 57; 57 is in 50 +- 10, 79 is not in 54 +- 10
    assert sentence(content, "training set that was run here") == (
        "2 published results have a training set that was run here. Beyond the ceiling on these "
        "data: 1. Within the 95 % interval of ours: 1."
    )
    ranked = sentence(content, "At 10 s")
    assert ranked.startswith("At 10 s, 2 of 2 networks are better than the running mean")
    assert "A is 50 to 54 %. Their RMSE is 1.07 to 1.16 times the ceiling." in ranked
    # sqrt(0.31^2 + 3.3^2 / 87) = 0.470 mdps
    assert "1 of 2 are better than what is expected of a constant" in ranked
    assert "changes A by +4 points, in 1 comparisons" in sentence(content, "virtual gyroscopes")
    assert not [one for one in content["findings"] if "Adding real" in one]
    assert "smallest p value of 2 is 1" in sentence(content, "No estimator beats")
    assert content["comparison"].iloc[0].to_dict() == {
        "Sensor": "sparkfun",
        "Window s": 10.0,
        "Running mean": 1.0,
        "Constant, expected": 0.47,
        "Networks, worst": 0.5,
        "Networks, best": 0.46,
        "Ceiling": 0.43,
        "Networks": 2,
    }


def test_a_network_that_beats_the_oracle_is_called_a_defect(write):
    content, _ = write(runs=[stored(0, "mean"), stored(1), stored(2, oracle_p=1e-6)])
    assert sentence(content, "best possible").startswith("DEFECT OF THE EVALUATION: 1 beat")


def test_a_run_that_studies_share_counts_once(write, rows):
    again = pd.DataFrame([row | {"run_ids": f"run{n + 3}"} for n, row in enumerate(rows)])
    twins = [stored(n + 3, "cnn" if n else "mean", fingerprint=f"fingerprint{n}") for n in range(3)]
    other = {"real2real.reporting.results": again, "real2real.reporting.all_runs": twins}
    content, _ = write(**other)
    assert dict(content["facts"])["Networks"].startswith("2 trained")
    assert "2 of 2 networks" in sentence(content, "At 10 s")
    assert [study["name"] for study in content["studies"]] == ["augmentation", "real2real"]


def test_what_is_missing_is_shown_and_named(write, rows):
    rows[2] |= {"missing": COMMAND, "run_ids": None}
    missing = Missing((COMMAND,))
    gap = {"tables.three_gyroscopes": missing, "gaps.three_gyroscopes": missing.reasons}
    content, gaps = write(**{f"augmentation.reporting.{name}": part for name, part in gap.items()})
    assert gaps == (COMMAND,)
    shown = item(content, "tables", "Three real gyroscopes")
    assert shown["table"] is None
    assert shown["missing"] == [f"{COMMAND} --env=smoke"]
    other = item(content, "figures", "DOT: 3 real gyroscopes and virtual ones")
    assert other["missing"] == ["kedro run --pipeline=augmentation --env=smoke"]
    assert content["studies"][0]["missing"] == [f"{COMMAND} --env=smoke"]


def test_without_any_run_the_report_says_so(write, rows):
    rows[:] = [row | {"missing": COMMAND, "run_ids": None} for row in rows]
    content, _ = write(runs=[])
    assert "no finished run" in dict(content["facts"])["Data"]
    assert len(content["findings"]) == 1  # what holds without runs
    assert content["comparison"].empty


def test_what_others_left_in_the_folder_is_shown(write):
    folder = {
        THREE: pd.DataFrame({"old": [1]}),
        "tables/augmentation_multiple_gyroscopes": TABLE,
        "tables/warm_up_results": TABLE,
        "tables/other_devices": TABLE,
    }
    content, _ = write(folder=folder)
    three, twelve = (item(content, "tables", f"{n} real gyroscopes") for n in ("Three", "Twelve"))
    assert list(three["table"]) == ["Approach", "A %"]
    assert not three["earlier"] and twelve["earlier"]
    assert item(content, "results", "All results of the study warm_up")["earlier"]
    assert [one["title"] for one in content["further"]] == ["Other devices"]
    # what a page has said it does not say again
    assert three["caption"].startswith("Windows of 10 s; S and A in percent")
    assert twelve["caption"] == "To be read like “Three real gyroscopes”."


# how it is written


@pytest.fixture
def page(tmp_path):
    return ReportPage(str(tmp_path / "report"))


@pytest.fixture
def figure(tmp_path):
    dataset = ReportFigure(str(tmp_path / "simulated" / "figures" / "augmentation_dot_3_real"))
    dataset.save(plt.subplots()[0])
    return dataset.load()


def test_the_page_needs_no_other_file_and_its_text_says_the_same(write, page, figure, tmp_path):
    name = "augmentation.reporting.figures.dot_3_real"
    content, _ = write(folder={"tables/<i>x": TABLE}, source="<u>`a`", **{name: figure})
    page.save(content)
    html = (tmp_path / "report.html").read_text()
    (picture,) = re.findall(r'src="([^"]*)"', html)
    assert base64.b64decode(picture.removeprefix("data:image/png;base64,")) == figure.read_bytes()
    assert not re.search(r"<(script|link|iframe|b|i|u)>|@import|url\(", html)  # all is escaped
    assert "&lt;b&gt;Real2Real" in html
    links = re.findall(r'href="([^"]*)"', html)
    assert "http://127.0.0.1:5000/#/experiments/7/runs/run1" in links
    assert {link for link in links if "127.0.0.1" not in link and link[0] != "#"} == {
        "../../README.md",
        "../../docs/how_it_works.md",
        "../../docs/honest_protocol.md",
        "../../docs/honest_protocol.md#the-ceiling",
    }
    inside = {link[1:] for link in links if link[0] == "#"}
    assert inside and inside <= set(re.findall(r'id="([^"]*)"', html))
    text = (tmp_path / "report.md").read_text()
    assert "](simulated/figures/augmentation_dot_3_real.png)" in text
    assert "| <b>Real2Real</b> | 51 [40, 60] |" in text
    assert "**Not made**:\n\n- Twelve real gyroscopes: run `kedro run --pipeline=augm" in text
    assert "`7/run1`" in text
    for finding in content["findings"]:
        assert finding in text


def test_a_narrowed_run_says_why_something_is_missing(write, rows, page, tmp_path):
    rows[2] |= {"missing": COMMAND, "run_ids": None}
    page.save(write(only=Only(sensor="sparkfun", window_s=10))[0])
    for suffix in ("html", "md"):
        text = (tmp_path / f"report.{suffix}").read_text()
        assert "since this run was narrowed to sensor=sparkfun, window_s=10.0:" in text
        assert "- Twelve real gyroscopes\n" in text or "<li>Twelve real gyroscopes</li>" in text
        assert COMMAND not in text


def test_the_folder_gives_all_tables_and_figures(tmp_path, figure, page):
    folder = ReportFolder(str(tmp_path / "simulated"))
    ReportTable(str(tmp_path / "simulated" / "tables" / "window_0.5s")).save(TABLE)
    (tmp_path / "simulated" / "tables" / ".half.csv").touch()
    found = folder.load()
    assert found.keys() == {"tables/window_0.5s", "figures/augmentation_dot_3_real"}
    pd.testing.assert_frame_equal(found["tables/window_0.5s"], TABLE)
    assert found["figures/augmentation_dot_3_real"] == figure
    assert ReportFolder(str(tmp_path / "none")).load() == {}
    with pytest.raises(DatasetError, match="one by one"):
        folder.save(TABLE)
    with pytest.raises(DatasetError, match="open it in a browser"):
        page.load()
