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


def test_unknown_preset_names_the_known():
    """Claim: an unknown preset is an error that names it and the known ones."""
    with pytest.raises(ValueError, match=r"'slow'.*smoke, quick"):
        presets.get("slow")


def test_smoke_learns_and_saves_on_the_way():
    """Claim: `smoke` leaves nothing out: it updates, saves between chunks, and goes on after
    that."""
    cfg = presets.smoke()
    assert cfg.train.learning_starts < cfg.train.actions / 2
    assert cfg.learn.updates_per_step >= 1
    assert cfg.train.save_every * cfg.train.chunk < cfg.train.steps
