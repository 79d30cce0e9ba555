"""The figure of docs/ceiling.md: what is possible against the published results.

    python benchmarks/ceiling_figure.py            # writes docs/ceiling.svg

Curves are computed; the published numbers are those of conf/base/parameters/published.yml.
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import yaml
from matplotlib import pyplot as plt

from gyro_pipeline.conventions import MDPS, PAPER
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import constant_bias, mean_squares

ROOT = Path(__file__).parents[1]
RATE_HZ = 20.0  # any will do: what matters is N, not the sample's sigma
SHARES = np.linspace(0.02, 0.6, 59)
KNOWN = 1e-6  # deg/s of turn-on spread: a bias known exactly


def gain(recording_s: float, noise: NoiseFigures, spread: float) -> list[float]:
    """Best accuracy gain, %, against the window's share of the recording."""
    samples = round(recording_s * RATE_HZ)
    model = constant_bias(samples, RATE_HZ, noise, 0.0, spread)
    squares = [mean_squares(model, 0, round(share * samples), PAPER) for share in SHARES]
    return [100 * (1 - np.sqrt(best / mean)) for best, mean in squares]


def main() -> None:
    mpl.rcParams.update({"svg.hashsalt": "ceiling", "svg.fonttype": "none", "font.size": 9})
    published = yaml.safe_load((ROOT / "conf/base/parameters/published.yml").read_text())
    sensors = yaml.safe_load((ROOT / "conf/base/globals.yml").read_text())["sensors"]
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    limit = 100 * (1 - np.sqrt(SHARES))
    axes.fill_between(SHARES, limit, 100, color="0.92", lw=0)
    axes.text(0.59, 93, "beyond what white noise without drift allows", ha="right", color="0.35")
    axes.plot(SHARES, limit, "k", label="bias known exactly, white noise: 1 − √r")
    dot = NoiseFigures(5.4 * MDPS, 3 * MDPS, 0.0)
    axes.plot(SHARES, gain(120, dot, KNOWN), "k--", label="the same, flicker of 3 mdps (DOT)")
    white = NoiseFigures(3.3 * MDPS, 0.0, 0.0)
    for spread, style in ((0.31, "-"), (1.0, "--"), (3.0, ":")):
        label = f"turn-on spread {spread:g} mdps (SparkFun)"
        axes.plot(SHARES, gain(87, white, spread * MDPS), "C0" + style, label=label)
    for sensor, marker in zip(sensors, "os^D", strict=False):
        rows = [row for row in published["published"]["results"] if row["sensor"] == sensor]
        if not rows:
            continue
        share = [row["window_s"] / sensors[sensor]["recording_s"] for row in rows]
        gains = [row["accuracy_gain_pct"] for row in rows]
        axes.plot(share, gains, "C3" + marker, label=f"published, {sensor}")
    axes.set(xlim=(0, 0.6), ylim=(0, 100))
    axes.set(xlabel="r: the window's share of the recording", ylabel="accuracy gain A, %")
    axes.legend(fontsize=7.5, loc="upper right", bbox_to_anchor=(1, 0.9))
    figure.savefig(ROOT / "docs/ceiling.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
