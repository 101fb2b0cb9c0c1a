"""Names and numbers that several stages share; imports no JAX, which reports do without."""

import enum


class Primitive(enum.IntEnum):
    """Kinds of action."""

    PUSH = 0
    GRASP = 1


class Outcome(enum.IntEnum):
    """Levels of a grasp, CSAC eq. 15, worst first."""

    NOTHING = 0
    EMPTY = 1
    TOUCHED = 2
    DROPPED = 3
    LIFTED = 4


OUTCOMES = tuple(outcome.name.lower() for outcome in Outcome)
CHANGE_AREA = 12.0  # cm^2 of the height map that must move for an action to count as a change (VPG)
GRASP_WINDOW = 200  # grasps of the running success rate (VPG; CSAC gives none)
RENAMED_SUITES = {"own": "in_distribution"}  # old name, in records, -> the name now
EVAL_SUITE = "in_distribution"  # of evaluations during training
EVAL_EPISODES = 20  # of each part of that suite (ours: an interval of some 20 points)
