"""Wiring of the reporting stage."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.reporting.nodes import (
    dot_3_real,
    dot_12_real,
    multiple_gyroscopes,
    pool_results,
    refuse_gaps,
    results_table,
    sparkfun_3_real,
    sparkfun_12_real,
    three_gyroscopes,
)
from gyro_pipeline.pipelines.reporting.report import write_report

_Makers = Mapping[str, Sequence[Callable[..., Any]]]

TABLES: _Makers = {"augmentation": [three_gyroscopes, multiple_gyroscopes]}
FIGURES: _Makers = {"augmentation": [sparkfun_3_real, sparkfun_12_real, dot_3_real, dot_12_real]}
"""The paper's tables and figures that each study carries."""


def create_pipeline(studies: Mapping[str, Sequence[str]]) -> Pipeline:
    """Tables and figures of some studies.

    Args:
        studies: All sensors of each study.
    """
    nodes, gaps, reported = [], [], []
    for study, sensors in studies.items():
        stage = f"{study}.reporting"
        pooled = [f"{stage}.results", f"{stage}.curves"]
        parts = "training splits virtual_gyros evaluation".split()
        settings = [f"params:{name}" for name in ["source", "windows_s", "seeds", *parts]]
        runs = [f"{study}.{sensor}.evaluation.runs" for sensor in sensors]
        nodes.append(
            Node(
                pool_results,
                [f"params:studies.{study}", *settings, *runs],
                pooled,
                name=f"pool_{study}",
                namespace="reporting",
            )
        )
        reported += [pooled[0], *runs]
        made: list[tuple[Callable[..., Any], str, list[str]]] = [
            (results_table, f"{stage}.tables.results", pooled[:1])
        ]
        for table in TABLES.get(study, []):
            made.append(
                (table, f"{stage}.tables.{table.__name__}", [pooled[0], "params:published"])
            )
        for figure in FIGURES.get(study, []):
            name = f"{stage}.figures.{figure.__name__}"
            made.append((figure, name, [*pooled, "params:published"]))
        for function, output, inputs in made:
            gap = f"{stage}.gaps.{function.__name__}"
            gaps.append(gap)
            reported.append(output)
            name = f"{function.__name__}_{study}"
            nodes.append(Node(function, inputs, [output, gap], name=name, namespace="reporting"))
    given = {name: f"params:{name}" for name in ("source", "only", "sensors", "published")}
    suffix = "_".join(studies)
    nodes += [
        Node(
            write_report,
            given | {"folder": "reporting.folder"} | {name: name for name in [*reported, *gaps]},
            ["reporting.report", "reporting.gaps"],
            name=f"write_report_of_{suffix}",
            namespace="reporting",
        ),
        Node(
            refuse_gaps,
            ["params:only", "reporting.gaps"],
            None,
            name=f"refuse_gaps_in_{suffix}",
            namespace="reporting",
        ),
    ]
    return Pipeline(nodes)
