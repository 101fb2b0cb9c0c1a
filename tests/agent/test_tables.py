"""Tables of alternatives, one per setting."""

import typing

from csac_jax import config
from csac_jax.agent import policy
from csac_jax.config import PolicyConfig, TargetConfig
from csac_jax.replay import samplers
from csac_jax.section import ALTERNATIVES
from csac_jax.training import transitions


def test_tables_are_total():
    """Claim: each table has every value that the config allows for its setting, and no other."""
    choices = lambda section, name: set(typing.get_args(section.__annotations__[name]))  # noqa: E731
    assert set(policy.PRIMITIVE_RULES) == choices(PolicyConfig, "primitive")
    assert set(transitions.BOOTSTRAPS) == choices(TargetConfig, "bootstrap")
    assert set(samplers.BUILDERS) == set(typing.get_args(config.ReplayConfig))
    assert set(samplers.BUILDERS) == set(ALTERNATIVES["replay"][1])
