import json
from typing import Annotated, Any, ClassVar

import msgspec
import pytest

from qfolio.core.config import Config, read_config, write_config
from qfolio.core.errors import QfolioError


class Part(msgspec.Struct):
    steps: int


class Sample(Config, frozen=True, kw_only=True):
    kind: ClassVar[str] = "sample"
    format: ClassVar[int] = 3
    seeds: Annotated[int, msgspec.Meta(ge=1)]
    far: int | None
    settings: dict[str, Any]
    parts: dict[str, Part]

    def __post_init__(self):
        if self.far == self.seeds:
            raise QfolioError("far equals seeds.")


SAMPLE = Sample(seeds=2, far=None, settings={"a": "inf"}, parts={"x": Part(3)})


def test_what_is_written_is_read(tmp_path):
    write_config(tmp_path / "config.json", SAMPLE)
    assert read_config(tmp_path / "config.json", Sample) == SAMPLE
    content = json.loads((tmp_path / "config.json").read_text())
    assert (content["kind"], content["format"]) == ("sample", 3)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seeds": "two"}, r"config.json is damaged \(seeds: expected int, got str\); restore it"),
        ({"seeds": True}, "seeds: expected int, got bool"),
        ({"seeds": 0}, "seeds: expected int >= 1"),
        ({"far": 1.5}, r"far: expected int \| null, got float"),
        ({"parts": {"x": {}}}, r"\(parts\[...\].steps is missing\)"),
        ({"far": 2}, r"\(far equals seeds\)"),
        ({"kind": "backtest"}, "is a backtest, not a sample"),
        ({"kind": 7}, "in another format"),
        ({"format": 2, "version": "0.1"}, "was written by qfolio 0.1 in another format, an older"),
        ({"format": 4}, "another format, a newer one; this is .*: update qfolio, or start over"),
    ],
)
def test_what_does_not_fit_is_named(change, says, tmp_path):
    path = tmp_path / "config.json"
    write_config(path, SAMPLE)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(QfolioError, match=says):
        read_config(path, Sample)


def test_missing_settings(tmp_path):
    with pytest.raises(QfolioError, match="is no sample: it has no config"):
        read_config(tmp_path / "config.json", Sample)
    (tmp_path / "config.json").write_text('{"kind": "sample", "format": 3}')
    with pytest.raises(QfolioError, match=r"\(seeds is missing\)"):
        read_config(tmp_path / "config.json", Sample)
