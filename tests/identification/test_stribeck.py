"""Stribeck's curves, found from a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factories.chains import RATE, motion, urdf_in
from jaximp.identification import FilterSettings, Pipeline, estimate
from jaximp.identification.prepared import prepare
from jaximp.models import Chain
from jaximp.recordings import recording_from_arrays
from jaximp.types import Recording

VELOCITY, EXPONENT = np.array([0.25, 0.12]), np.array([1.0, 1.0])
STRIBECK, COULOMB, VISCOUS = np.array([1.5, 0.8]), 0.5, 0.8


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    path = urdf_in(tmp_path_factory.mktemp("urdf"))
    return Chain.from_urdf(path, friction=("viscous", "coulomb", "stribeck"), stribeck="estimate")


def recorded(chain: Chain, seed: int, sizes: np.ndarray = STRIBECK) -> Recording:
    true, (time, q, dq, ddq) = chain.with_stribeck(VELOCITY, EXPONENT), motion(seed, 30.0)
    given = {"viscous_friction": [VISCOUS] * 2, "coulomb_friction": [COULOMB] * 2, "stribeck_friction": sizes}
    theta = np.array(true.parameters)
    for k, name in enumerate(chain.names):
        joint, _, what = name.partition(".")
        theta[k] = given[what][int(joint[-1]) - 1] if what in given else theta[k]
    noise = 0.05 * np.random.default_rng(seed).normal(size=q.shape)
    return recording_from_arrays(time, q, np.asarray(true.observation_matrix(q, dq, ddq)) @ theta + noise)


@pytest.fixture(scope="module")
def pipeline(chain: Chain) -> Pipeline:
    return Pipeline(RATE, chain, filter=FilterSettings(position_cutoff=20.0, decimation_cutoff=10.0))


@pytest.mark.slow  # four recordings
def test_curves_are_found_within_their_errors(chain: Chain, pipeline: Pipeline) -> None:
    apart = []
    for seed in range(4):
        curves = prepare(pipeline, recorded(chain, seed)).curves
        assert curves is not None
        truth = np.log(np.concatenate([VELOCITY, EXPONENT]))
        found = np.log(np.concatenate([curves.velocity, curves.exponent]))
        stderr = np.sqrt(np.diagonal(curves.covariance))
        np.testing.assert_allclose(found, truth, atol=0.25)
        apart.append((found - truth) / stderr)
    assert 0.5 < np.sqrt(np.mean(np.square(apart))) < 1.6


def test_what_is_not_known_of_curves_is_among_the_errors(chain: Chain, pipeline: Pipeline) -> None:
    made = recorded(chain, 1)
    found = estimate(pipeline, made)[0]
    curves = prepare(pipeline, made).curves
    assert curves is not None
    given = replace(pipeline, model=chain.with_stribeck(curves.velocity, curves.exponent))
    plain = estimate(given, made)[0]
    np.testing.assert_allclose(found.value, plain.value, rtol=1e-8)
    grown = dict(zip(found.names, (found.stderr / plain.stderr)[0], strict=True))
    assert min(grown.values()) >= 1
    assert grown["joint1.coulomb_friction"] > 1.5
    assert grown["link2.Iyy"] < 1.2
    assert any(note.startswith("Stribeck's curves by this recording: shoulder at") for note in found.notes)


def test_a_curve_that_is_not_there_is_said_not_to_be_determined(chain: Chain, pipeline: Pipeline) -> None:
    found = prepare(pipeline, recorded(chain, 2, np.array([1.5, 0.0])))
    assert found.curves is not None
    words = found.curves.in_words(chain.joint_names)
    assert "the recording does not determine Stribeck's curve of elbow" in words
    assert "shoulder at 0.2" in words
    assert np.isfinite(found.curves.covariance).all()


def test_what_is_wrong_is_said_in_one_line(chain: Chain, pipeline: Pipeline, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match='needs friction that has a curve: add "stribeck" to friction'):
        Chain.from_urdf(urdf_in(tmp_path), friction=True, stribeck="estimate")
    with pytest.raises(ValueError, match="stribeck is 'guess': give velocity and exponent"):
        Chain.from_urdf(urdf_in(tmp_path), friction="stribeck", stribeck="guess")
    whitened = replace(pipeline, window=replace(pipeline.window, estimates="generalised"))
    with pytest.raises(ValueError, match="Stribeck's curves are looked for by ordinary least squares"):
        prepare(whitened, recorded(chain, 0))
