"""The training command replaces the weights that ship only once training is complete."""

import argparse

import pytest

from pipeline.embedded import __main__ as command


@pytest.mark.parametrize("ended", [True, False])
def test_weights_are_replaced_only_once_every_stage_is_complete(monkeypatch, tmp_path, capsys, ended):
    exported, asked = [], []
    monkeypatch.setattr(command, "_make_shards", lambda *_: None)
    for name in ("Autoencoder", "Denoiser", "Descriptors"):
        stage = type(name, (), {"name": name.lower(), "__init__": lambda self, *_: None})
        monkeypatch.setattr(command, name, stage)
    monkeypatch.setattr(command, "train", lambda stage, *_, **__: asked.append(stage.name) or ended)
    monkeypatch.setattr(command, "export", lambda *_: exported.append(True) or 1)
    options = {"threads": 0, "minutes": 1.0, "scale": 1.0, "batch": 1.0, "device": "cpu", "workers": 0}
    command.run(argparse.Namespace(folder=tmp_path, **options))
    assert asked == (["autoencoder", "denoiser", "descriptors"] if ended else ["autoencoder"])
    assert exported == ([True] if ended else [])
    assert ("is unchanged" in capsys.readouterr().out) is not ended


@pytest.mark.parametrize(
    "asked", [["--device", "tpu"], ["--workers", "-1"], ["--batch", "0"], ["--scale", "nan"], ["--minutes", "x"]]
)
def test_a_wrong_option_is_named(monkeypatch, capsys, asked):
    monkeypatch.setattr("sys.argv", ["pipeline.embedded", *asked])
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert ended.value.code == 2
    assert f"argument {asked[0]}" in capsys.readouterr().err
