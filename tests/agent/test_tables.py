"""Tables of alternatives, one per setting."""

import dataclasses
import typing

import pytest

from csac_jax import config
from csac_jax.agent import critic, losses, policy, rewards
from csac_jax.config import CEMConfig, LearnConfig, PolicyConfig, RewardConfig, TargetConfig
from csac_jax.replay import samplers
from csac_jax.training import transitions


@pytest.mark.parametrize(
    ("table", "section", "name"),
    [
        (critic.NEXT_VALUES, TargetConfig, "value"),
        (policy.CEM_STARTS, CEMConfig, "start"),
        (policy.POSE_SEARCHES, PolicyConfig, "place"),
        (policy.PRIMITIVE_RULES, PolicyConfig, "primitive"),
        (rewards.GOOD_PUSH, RewardConfig, "push_label"),
        (losses.TD_LOSSES, LearnConfig, "loss"),
        (transitions.BOOTSTRAPS, TargetConfig, "bootstrap"),
    ],
)
def test_tables_are_total(table, section, name):
    """Claim: each table has every value that the config allows for its setting, and no other."""
    field = next(field for field in dataclasses.fields(section) if field.name == name)
    assert set(table) == set(typing.get_args(field.type))


@pytest.mark.parametrize(
    ("table", "union", "section"), [(samplers.BUILDERS, config.ReplayConfig, "replay")]
)
def test_tables_of_sections_are_total(table, union, section):
    """Claim: each table has every alternative of its section, and no other; so has the config's."""
    assert set(table) == set(typing.get_args(union))
    assert set(table) == set(config.ALTERNATIVES[section][1])
