"""Tables of alternatives, one per setting."""

import dataclasses
import typing

import pytest

from csac_jax.agent import cem, losses, policy, rewards
from csac_jax.config import CEMConfig, LearnConfig, PolicyConfig, RewardConfig


@pytest.mark.parametrize(
    ("table", "section", "name"),
    [
        (cem.STD_ESTIMATORS, CEMConfig, "std_estimator"),
        (policy.CEM_STARTS, CEMConfig, "start"),
        (policy.POSE_SEARCHES, PolicyConfig, "place"),
        (policy.PRIMITIVE_RULES, PolicyConfig, "primitive"),
        (rewards.GOOD_PUSH, RewardConfig, "push_effect"),
        (losses.TD_LOSSES, LearnConfig, "loss"),
        (losses.TARGET_UPDATES, LearnConfig, "target_update"),
    ],
)
def test_tables_are_total(table, section, name):
    """Claim: each table has every value that the config allows for its setting, and no other."""
    field = next(field for field in dataclasses.fields(section) if field.name == name)
    assert set(table) == set(typing.get_args(field.type))
