"""Search of settings with Optuna; needs `pip install optuna`.

python examples/07_optuna_search.py [PRESET] [FOLDER] [TRIALS] [EPISODES]

Each trial is a run of its own: FOLDER/trial-N. Bad trials end early, by the success in training.
The study lies in FOLDER/study.db: the same command goes on with it.
"""

import sys
from pathlib import Path

import optuna

import csac_jax as csac


class Prune(csac.Callback):
    """Ends a trial that does worse than half of the others did at that point."""

    def __init__(self, trial):
        self.trial = trial

    def chunk(self, record, state):
        if record.grasp_success is not None:
            self.trial.report(record.grasp_success, record.actions)
        if self.trial.should_prune():
            raise optuna.TrialPruned


def main(preset="quick", folder="runs/optuna", trials="20", episodes="50"):
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)

    def objective(trial):
        learn = {
            "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True),
            "tau": trial.suggest_float("tau", 0.005, 0.1, log=True),
        }
        gamma = trial.suggest_float("gamma", 0.0, 0.7)
        cfg = csac.presets.get(preset).change(learn=learn, target={"gamma": gamma})
        run_dir = folder / f"trial-{trial.number}"
        run = csac.train(cfg, run_dir, callbacks=[Prune(trial)], verbose=False)
        return csac.evaluate(run.policy, episodes=int(episodes))["completion"]["value"]

    study = optuna.create_study(
        study_name=preset,
        storage=f"sqlite:///{folder / 'study.db'}",
        direction="maximize",
        load_if_exists=True,
    )
    study.optimize(objective, n_trials=int(trials))
    return study


if __name__ == "__main__":
    print(main(*sys.argv[1:]).best_trial)
