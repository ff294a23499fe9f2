"""The benchmark of voxels against triangles: its scenes are comparable, and its differences free of noise."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxlidar as jl

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    """The module of the benchmark."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.delitem(sys.modules, "_common", raising=False)
    yield importlib.import_module("mesh_or_voxels")
    for name in ("_common", "mesh_or_voxels"):
        sys.modules.pop(name, None)


def test_triangles_and_voxels_have_the_same_leaf_area(benchmark):
    tree = jl.grow(jl.shrub(height=1.0, stems=1), seed=0)
    (mesh,) = benchmark.mesh_scene(tree).meshes
    is_leaf = mesh.group == mesh.materials.index("leaf")
    corners = np.asarray(mesh.vertices)[np.unique(np.c_[mesh.group, mesh.faces][is_leaf], axis=0)[:, 1:]]
    first, second = (corners[:, k] - corners[:, 0] for k in (1, 2))
    area = 0.5 * np.linalg.norm(np.cross(first, second), axis=1).sum()
    voxels = {kind: benchmark.voxel_scene(tree, 0.2, kind).canopy.voxels for kind in benchmark.KINDS}
    leaf_areas = {kind: 2 * float(v.leaf.sum()) * 0.2**3 for kind, v in voxels.items()}
    assert leaf_areas["by area"] == pytest.approx(area, rel=1e-4)
    # That of the probability map depends on the edge of its voxels.
    assert leaf_areas["by volume"] < 0.5 * area


def test_noise_is_subtracted_from_differences(benchmark):
    """Two flat records that differ by 5 % everywhere, with noise of 10 % in each of four runs."""
    random = np.random.default_rng(0)
    height = np.linspace(20.0, 0.0, 2000)

    def runs(level):
        waves = level * (1.0 + 0.1 * random.normal(size=(4, height.size)))
        return benchmark.Runs(height, dict.fromkeys(("all orders", *benchmark.PARTS), waves))

    reference, other = runs(1.0), runs(1.05)
    row = benchmark.compare(other, reference, "all orders")
    noise = 0.1 * np.sqrt((1.0 + 1.05**2) / 4)
    assert row["rms of noise"] == pytest.approx(noise, rel=0.05)
    assert row["rms"] == pytest.approx(0.05, abs=0.005)
    # With the noise it would be larger than what the test admits.
    assert np.hypot(row["rms"], row["rms of noise"]) > 0.06
    assert row["differences"]["total"] == pytest.approx(0.05 * height.size, abs=3 * row["errors"]["total"])
    assert row["errors"]["total"] < 0.01 * height.size
