"""Several seeds in tables and figures, and which of them is shipped."""

from pathlib import Path
from typing import Any

import pytest

from telebip.errors import UserError
from telebip.eval import plots
from telebip.eval.report import BEGIN, END, write_tables
from telebip.eval.study import mean_cost, median_seed
from telebip.eval.tables import over_seeds, overview, short_overview


def found(seed: int, *costs: float | None, falls: int = 0) -> dict[str, Any]:
    rows = [
        {"command_mps": 0.5 + 0.2 * i, "mean_speed_mps": 0.55 + 0.2 * i, "cot_mechanical": cost, "cot_article": cost}
        | {"falls": falls, "worlds": 64}
        for i, cost in enumerate(costs)
    ]
    return {"label": "RL", "training": {"seed": seed, "task": "t"}, "tracking": rows, "engine": "native"}


def test_the_median_of_the_seeds_without_a_fall_is_shipped() -> None:
    seeds = {1: found(1, 0.2, 0.4), 2: found(2, 0.1, 0.1, falls=1), 3: found(3, 0.2, 0.2), 4: found(4, 0.25, 0.25)}
    assert mean_cost(seeds[1]) == pytest.approx(0.3)
    assert median_seed(seeds) == 4
    assert median_seed({1: seeds[1], 3: seeds[3]}) == 3  # the cheaper one of two
    assert median_seed({2: seeds[2]}) == 2  # where all fall there is no other
    assert median_seed({1: found(1, None, 0.1), 3: seeds[3], 4: seeds[4]}) == 4  # without a cost it is the dearest


def test_a_number_over_seeds() -> None:
    assert over_seeds([0.5], 2) == "0.50"
    assert over_seeds([1.0, 2.0, 3.0, 4.0, 900.0], 1, " %").startswith("3.0 % [1.")
    assert over_seeds([2.0, None, 2.0, 2.0], 0) == "2 [2, 2] (3 of 4 seeds)"
    assert over_seeds([None], 1) == "-"


def test_tables_are_written_between_the_markers_again_and_again(tmp_path: Path) -> None:
    page = tmp_path / "results.md"
    page.write_text(f"# Results\n\n{BEGIN}\n{END}\n\nWhat to make of it.\n")
    group = [found(seed, 0.1 * seed) for seed in (1, 2, 3, 4, 5)]
    texts = []
    for _ in range(2):
        write_tables(page, overview([group]))
        texts.append(page.read_text())
    assert texts[0] == texts[1]
    assert "| RL | 5 seeds | 0.300 [" in texts[0]
    assert "0 of 320" in texts[0]
    assert texts[0].endswith("What to make of it.\n")
    page.write_text("no markers")
    with pytest.raises(UserError, match="lacks the lines"):
        write_tables(page, overview([group]))


def test_the_table_of_the_readme_has_no_heading_and_a_dash_for_what_is_not_measured(tmp_path: Path) -> None:
    page = tmp_path / "README.md"
    page.write_text(f"{BEGIN}\n{END}\n")
    pushed = {"push": {"10s": {"forward_n": 100.0, "backward_n": 90.0, "lateral_n": 40.0}}}
    walkers = {"three": [{**found(seed, 0.1, 0.1 * seed), **pushed} for seed in (1, 2, 3)], "one": [found(1, 0.3, falls=2)]}
    write_tables(page, [short_overview(walkers)])
    header, _, three, one = (line for line in page.read_text().splitlines() if line.startswith("|"))
    assert "#" not in page.read_text()
    assert header.startswith("| walker | seeds | cost of transport |")
    assert three.startswith("| `three` | 3 seeds | 0.200 [0.1")  # that at 0.7 m/s
    assert three.endswith("| 10.0 % [10.0, 10.0] | 0 of 384 | 100 [100, 100] | 90 [90, 90] | 40 [40, 40] |")
    assert one == "| `one` | 1 seed | - | 10.0 % | 2 of 64 | - | - | - |"


def test_a_bar_is_the_interquartile_mean_and_each_seed_is_a_dot() -> None:
    group = [found(seed, cost) for seed, cost in enumerate((0.1, 0.2, 0.3, 0.4, 0.9), 1)]
    axes = plots.cost_of_transport([group, [found(1, 0.5)]]).axes[0]
    bars = [patch.get_width() for patch in axes.patches]  # pyright: ignore[reportAttributeAccessIssue]
    assert bars == pytest.approx([0.3, 0.5])
    dots, interval = axes.lines  # of the first walker alone
    assert sorted(dots.get_xdata()) == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.9])  # pyright: ignore[reportArgumentType]
    assert min(interval.get_xdata()) < 0.3 < max(interval.get_xdata())  # pyright: ignore[reportArgumentType]
