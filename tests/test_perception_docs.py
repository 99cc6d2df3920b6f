"""What docs/perception_service.md says of the code is true."""

from __future__ import annotations

from pathlib import Path

from perception_server.history import HistoryLimits
from perception_server.image_wish import IMAGE_PRESETS
from perception_server.request_status import Stage
from straitlink.perception_config import TABLES, PerceptionTable

TEXT = (Path(__file__).resolve().parent.parent / "docs" / "perception_service.md").read_text()
ROWS = {
    cells[0].strip("`"): cells
    for line in TEXT.partition("## Measured")[0].splitlines()
    if line.startswith("|")
    for cells in [[cell.strip() for cell in line.strip("|").split(" | ")]]
}


def test_every_key_of_the_configuration_is_described() -> None:
    for table in (*TABLES.values(), PerceptionTable):
        for name in table.model_fields:
            assert f"`{name}`" in TEXT or f"[{name}" in TEXT, name


def test_the_presets_are_those_of_the_code_with_their_sizes_and_qualities() -> None:
    for name, preset in IMAGE_PRESETS.items():
        _, picture, quality = ROWS[name]
        if preset.width_px and not preset.chip_quality:
            assert f"{preset.width_px}x{preset.height_px}" in picture, name
        said = [value for value in (preset.quality, preset.chip_quality) if value]
        assert quality == ", ".join(map(str, said)), name


def test_every_stage_is_described() -> None:
    for stage in Stage:
        assert f"`{stage.value}`" in TEXT, stage


def test_the_bounds_of_the_history_are_those_of_the_code() -> None:
    limits = HistoryLimits()
    for value in (limits.max_scan_points, limits.max_cloud_points, limits.max_picture_bytes):
        assert f"{value:,}" in TEXT
    assert f"| {limits.duration_s:g} |" in TEXT
