"""Named configs."""

import pytest

from csac_jax import presets
from csac_jax.training import loop


@pytest.mark.parametrize("name", list(presets.PRESETS))
def test_preset_knows_its_name(name: str):
    """Claim: a run's config names the preset it was made from."""
    assert presets.get(name).preset == name
    assert presets.PRESETS[name]().preset == name


@pytest.mark.parametrize("name", list(presets.PRESETS))
def test_preset_runs_whole_chunks(name: str):
    """Claim: a preset takes as many actions as it says, none added to fill a chunk."""
    cfg = presets.get(name)
    assert loop.total_steps(cfg) * cfg.train.scenes == cfg.train.actions
