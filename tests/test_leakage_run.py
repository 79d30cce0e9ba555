"""``kedro run --pipeline=leakage`` on the smoke environment; no other run has any of it."""

FEW = {"strides_s": [10], "folds": 2, "training": {"steps": 4}, "recordings": 4}
REPORT = "data/08_reporting/simulated_smoke"
WRITTEN = {
    *(f"tables/leakage_results.{ending}" for ending in ("csv", "md", "tex")),
    *(f"figures/leakage_accuracy_against_stride.{ending}" for ending in ("png", "svg")),
}
BY_RECORDING = [("k_fold", name) for name in ("mean", "training_mean", "cnn", "cnn_shuffled")]
WAYS = {
    **dict.fromkeys(BY_RECORDING, 3),  # of fits: two folds, and all recordings
    **dict.fromkeys((("window_split", "cnn"), ("best_epoch_on_test", "cnn")), 2),
    ("test_in_training", "cnn"): 1,
}


def test_each_way_of_training_is_one_run_made_once(new_project):
    project = new_project()

    def run(study=FEW, **params):
        given = {"execution": {"executor": "serial"}, "studies": {"leakage": study}}
        return project.run_here("leakage", "smoke", **given | params)

    done = run()
    assert done.code == 0, done.output
    runs = project.runs("leakage")
    ways = {(one.data.params["protocol"], one.data.params["estimator"]): one for one in runs}
    assert len(runs) == len(ways)
    fits = {way: sum(tag.startswith("fit.") for tag in one.data.tags) for way, one in ways.items()}
    assert fits == WAYS
    for (protocol, _), one in ways.items():
        assert (one.info.status, one.data.params["window_stride_s"]) == ("FINISHED", "10.0")
        assert protocol in one.info.run_name
        assert protocol in one.data.tags["mlflow.note.content"]
    leaks = [path for path in project.files(REPORT) if "leakage_" in path]
    assert {"/".join(path.split("/")[-2:]) for path in leaks} == WRITTEN
    (results,) = [path for path in project.files() if path.endswith("leakage/results.csv")]
    assert len((project.folder / results).read_text().splitlines()) == 1 + 5
