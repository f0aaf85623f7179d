"""Decoders as ONNX graphs: what the graph says by onnx's own evaluator is what our decoder says."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")
sys.path += [str(Path(__file__).parent), str(Path(__file__).parent.parent / "tracer")]

import onnx
import torch
from neural_examples import lively, random_queries
from onnx.reference import ReferenceEvaluator
from scenes import fabric

from usdfab.cli.main import _run
from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, weave_from_name
from usdfab.neural import onnx_graph
from usdfab.neural.asset_file import save_asset_network
from usdfab.neural.asset_network import AssetMaterial, first_network
from usdfab.neural.decoder import Plan, plan_of
from usdfab.neural.material_file import Weights
from usdfab.neural.network import KINDS, MaterialNetwork
from usdfab.neural.onnx_graph import INPUTS, OUTPUTS, fabric_decoders, graph_of
from usdfab.usd.fabric_io import read_fabric, write_fabric

CLOTH = fabric("twill 2/1")
COUNT = 60


def asked(model, queries: np.ndarray, side: np.ndarray, **more: np.ndarray) -> dict[str, np.ndarray]:
    """What the graph answers."""
    given = {"side": side, "footprint": queries[:, :3], "incoming": queries[:, 3:6], "outgoing": queries[:, 6:]}
    return dict(zip(OUTPUTS, ReferenceEvaluator(model).run(list(OUTPUTS), given | more), strict=True))


def plan_answers(plans: list[Plan], queries: np.ndarray, side: np.ndarray) -> np.ndarray:
    return np.where(side[:, None] == 0, *(plan.decode(queries) for plan in plans))


def brighter(network: MaterialNetwork) -> MaterialNetwork:
    """With answers above 0, whose differences are seen."""
    with torch.no_grad():
        network.get_parameter("last.bias" if network.architecture == "lean" else "angular_out.bias").add_(1.0)
    return network


def check(model, plans: list[Plan], albedo: np.ndarray, kind: str) -> None:
    queries = random_queries(COUNT, 3, below=kind == "transmission")
    side = np.arange(COUNT) % 2
    true, found = plan_answers(plans, queries, side), asked(model, queries, side)
    assert (true > 0.0).mean() > 0.9 and (np.ptp(true, axis=0) > 0.1 * true.mean(axis=0)).all()
    np.testing.assert_allclose(found["components"], true, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found["color"], true @ albedo, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("architecture", ["lean", "paper"])
def test_the_graph_answers_as_the_decoder(architecture: str) -> None:
    networks = {kind: Weights(brighter(lively(architecture, kind)), {}) for kind in KINDS}
    decoders, tile = fabric_decoders(CLOTH, networks, None, "")
    assert tile == (CLOTH.weave.ends, CLOTH.weave.picks)
    for kind, decoder in decoders.items():
        plans = [plan_of(decoder.network, code) for code in torch.from_numpy(decoder.codes)]
        check(graph_of(decoder, {}), plans, decoder.albedo, kind)


def own_material(cloth: FabricParameters) -> AssetMaterial:
    networks = {kind: first_network(cloth, brighter(lively("lean", kind))) for kind in KINDS}
    picks, ends = cloth.repeat()
    return AssetMaterial((ends, picks), networks, np.linspace(0.5, 1.5, 8).reshape(2, 4))


def test_a_fabrics_own_network_and_other_codes() -> None:
    """Places outside the tile are those within; codes that are given take the place of those in the file."""
    material = own_material(CLOTH)
    decoders, tile = fabric_decoders(CLOTH, {}, material, "")
    assert tile == material.tile
    decoder = decoders["reflection"]
    plans = material.networks["reflection"].plans()
    model = graph_of(decoder, {"fabric": CLOTH.name, "tile_yarns": list(tile)})
    check(model, plans, material.albedo[0], "reflection")
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert said["kind"] == "reflection" and json.loads(said["components"]) == ["red", "green", "gloss", "blue"]
    assert {f"input {name}" for name in INPUTS} | {f"output {name}" for name in OUTPUTS} <= set(said)
    queries, side = random_queries(COUNT, 4), np.zeros(COUNT, dtype=np.int64)
    moved = queries + np.array([3, -2, 0, 0, 0, 0, 0, 0], dtype=np.float32)
    first = asked(model, queries, side)["components"]
    np.testing.assert_allclose(asked(model, moved, side)["components"], first, rtol=1e-3, atol=1e-5)
    turned = asked(model, queries, side, codes=decoder.codes[::-1].copy())["components"]
    np.testing.assert_allclose(turned, asked(model, queries, 1 - side)["components"], rtol=1e-6)
    assert np.abs(turned - first).max() > 1e-3


def test_the_command_writes_two_graphs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "cloth.usda"
    write_fabric(CLOTH, source)
    target = tmp_path / "graphs"
    command = ["export", str(source), "--onnx", "-o", str(target), "--json"]
    assert _run(command) == 0
    said = json.loads(capsys.readouterr().out)
    assert [Path(file).name for file in said["files"]] == ["reflection.onnx", "transmission.onnx"]
    assert said["trained_on"] == "the surface model" and said["tile_yarns"] == [3, 3]
    model = onnx.load(said["files"][1])
    assert [value.name for value in model.graph.input] == list(INPUTS)
    assert all(value.doc_string for value in [*model.graph.input, *model.graph.output])
    assert _run(command) == 2 and "--overwrite" in capsys.readouterr().err
    assert _run([*command, "--overwrite", "--usdz"]) == 2 and "--usdz: does not go" in capsys.readouterr().err


def test_a_fabrics_own_network_is_what_is_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = tmp_path / "own.safetensors"
    named = replace(CLOTH, neural_weights=str(weights))
    write_fabric(named, source := tmp_path / "cloth.usda")
    save_asset_network(own_material(CLOTH), read_fabric(source), weights)
    command = ["export", str(source), "--onnx", "-o", str(tmp_path / "graphs"), "--json", "--overwrite"]
    assert _run(command) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["trained_on"] == "the fabric's fibers" and said["warnings"] == []
    write_fabric(replace(named, weave=weave_from_name("twill 1/2")), source, overwrite=True)
    assert _run(command) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["trained_on"] == "the surface model" and "not used" in said["warnings"][0]


def test_without_the_package_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_graph, "find_spec", lambda name: None)
    with pytest.raises(UsdfabError, match=r"needs the package onnx.*usdfab\[onnx\]"):
        onnx_graph.require_onnx()
