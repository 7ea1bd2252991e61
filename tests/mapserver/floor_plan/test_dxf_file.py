"""Lines of DXF drawings: what is read, what is left out, and what is refused."""

from pathlib import Path

import ezdxf
import numpy as np
import pytest

from fleetmap.errors import UsageError
from mapserver.floor_plan import dxf_file
from mapserver.floor_plan.plan_file import read_plan


def write(path: Path, draw=lambda space, document: None, units: int = 4) -> Path:  # type: ignore[no-untyped-def]
    document = ezdxf.new(units=units)
    document.modelspace().add_line((0, 0), (40_000, 0))
    draw(document.modelspace(), document)
    document.saveas(path)
    return path


def found(path: Path) -> set[tuple[int, ...]]:
    return {tuple(int(v) for v in np.rint(line)) for line in read_plan(path).lines()}


def test_lines_polylines_and_blocks_of_visible_layers(tmp_path: Path) -> None:
    def draw(space, document) -> None:  # type: ignore[no-untyped-def]
        space.add_lwpolyline([(0, 0), (0, 30_000), (9_000, 30_000)], close=False)
        space.add_circle((0, 0), 5_000)
        document.layers.add("furniture").off()
        space.add_line((5, 5), (9_000, 9_000), dxfattribs={"layer": "furniture"})
        column = document.blocks.new("column")
        column.add_line((0, 0), (600, 0))
        bay = document.blocks.new("bay")
        bay.add_blockref("column", (1_000, 0))
        space.add_blockref("bay", (10_000, 5_000), dxfattribs={"rotation": 90})
        space.add_line((0, 0), (20, 0))  # a symbol

    path = write(tmp_path / "hall.DXF", draw)
    assert found(path) == {
        (0, 0, 40_000, 0), (0, 0, 0, 30_000), (0, 30_000, 9_000, 30_000), (10_000, 6_000, 10_000, 6_600),
    }  # fmt: skip
    plan = read_plan(path)
    assert (plan.metres_per_unit, plan.name, plan.data) == (0.001, "hall.DXF", path.read_bytes())
    assert read_plan(write(tmp_path / "unknown.dxf", units=0)).metres_per_unit is None


def test_blocks_within_blocks_do_not_grow_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dxf_file, "_MAX_STEPS", 1000)

    def grown(width: int, depth: int):  # type: ignore[no-untyped-def]
        def draw(space, document) -> None:  # type: ignore[no-untyped-def]
            document.blocks.new("b0")
            for n in range(1, depth):
                block = document.blocks.new(f"b{n}")
                for _ in range(width):
                    block.add_blockref(f"b{n - 1}", (0, 0))
            space.add_blockref(f"b{depth - 1}", (0, 0))

        return draw

    for width, depth in ((1, 12), (20, 6)):
        with pytest.raises(UsageError, match="simplify it"):
            read_plan(write(tmp_path / "bomb.dxf", grown(width, depth)))


def test_what_is_no_drawing_is_refused(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.dxf").read_bytes()
    for name, data in (("text", b"plan"), ("torn", whole[: len(whole) // 3]), ("empty", b""), ("zeros", bytes(999))):
        path = tmp_path / f"{name}.dxf"
        path.write_bytes(data)
        with pytest.raises(UsageError, match="save it again as DXF"):
            read_plan(path)
