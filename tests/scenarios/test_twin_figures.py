"""Pictures of a twin report, from small arrays whose picture is known beforehand."""

import io

import numpy as np
import pytest
from matplotlib import image
from matplotlib.colors import same_color, to_rgb
from scipy.stats import multivariate_normal

from scenarios.studies.report.figures import (
    CRITICAL,
    MOST_POINTS,
    NORMAL,
    Line,
    bars_figure,
    density,
    difficulty_figure,
    latent_map_figure,
    latent_scatter_figure,
    lines_figure,
    picture,
    ranked,
    ranking_figure,
    reliability_figure,
    signals_figure,
)

RECORD = np.arange(20 * 3 * 7, dtype=float).reshape(20, 3, 7)


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def lines(axes, label):
    return [line for line in axes.get_lines() if line.get_label() == label]


def legend_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_records_stand_channel_by_channel_with_their_joint_in_its_colour():
    pair, others = (RECORD[:, :, 1], 2 * RECORD[:, :, 1]), np.delete(RECORD, 1, axis=2)
    figure = signals_figure(pair, 10.0, joint=1, title="finding", others=(others, 2 * others))
    axes = figure.axes
    assert len(axes) == 6
    assert [a.get_ylabel() for a in axes[::2]] == ["q (rad)", "dq/dt (rad/s)", "τ (N·m)"]
    assert all(a.get_xlabel() == "time (s)" for a in axes[4:])
    for a, record, colour in ((axes[4], RECORD, NORMAL), (axes[5], 2 * RECORD, CRITICAL)):
        (line,) = lines(a, "joint 2")
        np.testing.assert_array_equal(line.get_ydata(), record[:, 2, 1])
        np.testing.assert_allclose(line.get_xdata(), np.arange(20) / 10)
        assert same_color(line.get_color(), colour)
        assert len(a.get_lines()) == 7  # the joint itself before six others
    assert legend_of(figure) == ["joint 2, normal", "joint 2, critical", "other joints"]


def test_the_noise_of_a_still_joint_does_not_fill_its_axis():
    still = np.full((20, 3), 1e-7) * np.arange(20)[:, None]
    low, high = signals_figure((still, still), 10.0, joint=1, title="finding").axes[2].get_ylim()
    assert high - low == pytest.approx(0.1)


def test_neither_record_is_cut_off():
    seen = RECORD[:, :, 0]
    figure = signals_figure((seen, 3 * seen), 10.0, joint=1, title="finding")
    low, high = figure.axes[4].get_ylim()
    assert low <= seen[:, 2].min()
    assert high >= 3 * seen[:, 2].max()


def test_a_reconstruction_is_drawn_against_what_was_seen():
    seen = RECORD[:, :, 0]
    figure = signals_figure((seen, seen), 10.0, joint=3, title="finding", made=(seen + 1, seen - 2))
    (made,) = lines(figure.axes[1], "reconstruction")
    np.testing.assert_array_equal(made.get_ydata(), seen[:, 0] - 2)
    assert legend_of(figure) == ["joint 4, normal", "joint 4, critical", "reconstruction"]


def test_the_map_is_the_mean_of_the_posteriors_densities():
    mu, sigma = rng().normal(size=(6, 2)), rng().uniform(0.2, 0.6, (6, 2))
    x, y = np.linspace(-1, 1, 5), np.linspace(-2, 2, 4)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    parts = [multivariate_normal(m, np.diag(s**2)).pdf(points) for m, s in zip(mu, sigma, strict=True)]
    np.testing.assert_allclose(density(mu, sigma, x, y), np.mean(parts, axis=0), rtol=1e-12)


def test_the_latent_map_draws_an_ellipse_of_one_sigma_per_posterior():
    mu, sigma = rng().normal(size=(9, 2)), rng().uniform(0.2, 0.6, (9, 2))
    figure = latent_map_figure((mu, sigma), (mu[:4] + 2, sigma[:4]), joint=1, title="finding")
    ellipses = figure.axes[1].patches
    assert len(ellipses) == 13
    assert sum(to_rgb(e.get_edgecolor()) == to_rgb(NORMAL) for e in ellipses) == 9
    np.testing.assert_allclose(ellipses[0].get_center(), mu[0])
    assert ellipses[0].get_width() == pytest.approx(2 * sigma[0, 0])
    assert "joint 2" in figure.axes[0].get_xlabel()


def test_the_scatter_parts_low_from_high_temperature_and_never_draws_too_many():
    mu, temp_c = rng().normal(size=(3 * MOST_POINTS, 2)), np.full(3 * MOST_POINTS, 30.0)
    temp_c[:40] = 60.0
    figure = latent_scatter_figure(mu, temp_c, limit_c=60.0, joint=1, title="finding")
    low, high = figure.axes[0].collections
    assert len(low.get_offsets()) == MOST_POINTS
    assert sorted(map(tuple, high.get_offsets())) == sorted(map(tuple, mu[:40]))
    assert legend_of(figure) == ["below 60 °C", "60 °C and above"]


def test_difficulty_is_a_box_per_joint_and_kind_at_its_quartiles():
    cool, hot = rng().uniform(0, 0.5, (40, 7)), rng().uniform(0.5, 1, (30, 7))
    figure = difficulty_figure({"cool": cool, "hot": hot}, title="finding", unit="windows")
    boxes = figure.axes[0].patches
    assert len(boxes) == 14
    heights = boxes[1].get_path().vertices[:, 1]
    np.testing.assert_allclose([heights.min(), heights.max()], np.percentile(cool[:, 1], [25, 75]))
    assert legend_of(figure) == ["cool (40 windows)", "hot (30 windows)"]
    assert figure.axes[1].get_xlabel() == "d, sum over the joints"


def epochs_figure(epochs, known, held_out):
    panels = {
        name: {
            "trained on": Line(epochs, known[:, :, c], NORMAL, "o"),
            "held out": Line(epochs, held_out[:, :, c], "k"),
        }
        for c, name in ((2, "torque"), (0, "position"), (1, "velocity"))
    }
    ticks = {"log": True, "ticks": epochs, "from_zero": True}
    return lines_figure(panels, title="finding", x_label="epochs", y_label="σ", **ticks)


def test_epochs_show_the_mean_and_the_range_of_the_seeds():
    epochs, known = np.array([20, 60, 240]), rng().uniform(0.2, 1, (4, 3, 3))
    figure = epochs_figure(epochs, known, known + 1)
    assert [a.get_title(loc="left") for a in figure.axes] == ["torque", "position", "velocity"]
    (line,) = lines(figure.axes[0], "trained on")
    np.testing.assert_allclose(line.get_ydata(), known[:, :, 2].mean(axis=0))
    band = figure.axes[0].collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == pytest.approx(known[:, :, 2].min(axis=0).min())
    assert [t.get_text() for t in figure.axes[0].get_xticklabels()] == ["20", "60", "240"]


def test_a_ranking_puts_the_best_on_top_and_every_seed_as_a_dot():
    values = {name: {"AUROC": np.array([v, v + 0.01])} for name, v in (("PCA", 0.7), ("VAE", 0.9), ("kNN", 0.8))}
    figure = ranking_figure(values, ours=["VAE"], title="finding", targets={"AUROC": 0.93})
    axes = figure.axes[0]
    assert [t.get_text() for t in axes.get_yticklabels()] == ["PCA", "kNN", "VAE"]
    assert [same_color(bar.get_facecolor()[:3], NORMAL) for bar in axes.patches] == [False, False, True]
    assert axes.patches[2].get_width() == pytest.approx(0.905)
    assert any(list(line.get_xdata()) == [0.9, 0.91] for line in axes.get_lines())


def test_who_ties_in_the_first_measure_is_ranked_by_the_next():
    values = {
        "a": {"AUROC": np.array([0.9999, 1.0]), "Spearman": np.array([0.8, 0.8])},
        "b": {"AUROC": np.array([0.9998, 1.0]), "Spearman": np.array([0.9, 0.9])},
        "c": {"AUROC": np.array([0.98, 0.98]), "Spearman": np.array([1.0, 1.0])},
    }
    assert ranked(values) == ["c", "a", "b"]


def test_reliability_has_the_diagonal_and_the_counts():
    said = np.array([0.1, 0.9])
    figure = reliability_figure({"rc": (said, np.array([0.2, 0.8]), np.array([30, 4]))}, title="finding")
    (line,) = lines(figure.axes[0], "rc")
    np.testing.assert_array_equal(line.get_ydata(), [0.2, 0.8])
    assert [bar.get_height() for bar in figure.axes[1].patches] == [0, 30, 0, 0, 0, 0, 0, 0, 0, 4]


def test_pairs_stand_at_the_mean_of_their_seeds():
    figure = bars_figure(
        {"torque": {"cool": np.array([0.2, 0.4]), "hot": np.array([1.0, 1.0])}}, title="finding", y_label="σ"
    )
    cool, hot = figure.axes[0].patches
    assert (cool.get_height(), hot.get_height()) == (pytest.approx(0.3), 1.0)
    assert same_color(hot.get_facecolor()[:3], CRITICAL)
    assert [t.get_text() for t in figure.axes[0].texts] == ["0.3", "1"]


def test_a_long_title_fits_into_the_figure():
    zero = {"sum": {"work only": np.zeros(2), "with exploration": np.zeros(2)}}
    figure = bars_figure(zero, title="Exploration lowers false alarms " * 4, y_label="false alarms")
    figure.canvas.draw()
    assert figure.texts[0].get_window_extent().x1 < figure.bbox.width
    assert figure.axes[0].get_ylim()[0] == 0.0


def test_lines_carry_their_data_and_units():
    raw = Line(np.array([10, 50]), np.array([[1.0, 2.0], [3.0, 4.0]]), NORMAL)
    level = (60.0, "warning limit, 60 °C")
    labels = {"x_label": "n", "y_label": "motor temperature (°C)"}
    figure = lines_figure({"": {"raw": raw, "_hidden": raw}}, title="f", **labels, log=True, level=level)
    np.testing.assert_array_equal(lines(figure.axes[0], "raw")[0].get_ydata(), [2.0, 3.0])
    assert figure.axes[0].get_xscale() == "log"
    assert "°C" in figure.axes[0].get_ylabel()
    assert legend_of(figure) == ["raw", "warning limit, 60 °C"]
    roc = lines_figure(
        {"": {"d": Line(np.array([0, 1]), np.array([0, 1]), NORMAL)}}, title="f", **labels, diagonal=True
    )
    assert [line.get_linestyle() for line in roc.axes[0].get_lines()] == ["-", "--"]
    assert legend_of(roc) == ["d"]


def test_the_same_figure_is_the_same_png_and_nothing_is_cut_off():
    figures = [epochs_figure(np.array([20, 60]), *rng().uniform(0, 1, (2, 3, 2, 3))) for _ in range(2)]
    first, second = (picture("epochs", figure, "Epochs.").png for figure in figures)
    assert first == second
    pixels = image.imread(io.BytesIO(first))[..., :3]
    border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
    np.testing.assert_array_equal(border, 1.0)  # white
    assert (pixels < 1.0).any()
