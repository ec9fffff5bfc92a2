"""The first sentences say what the tables say."""

from support.run_folders import RunFolder

from crossgrad_plugins.compare.comparison import compared
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.narrative import headline
from crossgrad_plugins.compare.options import Options


def test_an_arm_that_leads_only_by_the_mean_is_not_reported_as_winner(tmp_path):
    # One run of two views diverged: less in the mean, more in eleven pairs of twelve.
    for number in range(12):
        scene, seed = f"scene {number % 4}", number // 4
        noise = 0.01 * seed
        finals = {1: 21.0, 2: 21.3 + noise - (9.0 if number == 5 else 0.0), 4: 19.0 + noise}
        for views, final in finals.items():
            run = RunFolder(scene, seed, final, views_per_step=views, evaluations=2)
            run.write(tmp_path / f"{views}-{number}")
    found = compared(read_runs([tmp_path], skip_broken=False), Options())
    assert found.ranking == ("views=1", "views=2", "views=4")
    first, second, *_ = headline(found)
    assert first.claim == "views=1 has the best mean"
    assert first.support.startswith("better than views=4 by 1.99 dB (+1.9")
    assert second.claim.startswith("It is worse than views=2 by 0.31 dB (-0.3")
    assert not any("is best at the end" in each.claim for each in (first, second))


def test_different_lengths_of_arms_are_reported(tmp_path):
    for views, steps in ((1, 300), (2, 900)):
        for seed in range(3):
            run = RunFolder("place", seed, 20.0 + views, views_per_step=views, steps=steps)
            run.write(tmp_path / f"{views}-{seed}")
    found = compared(read_runs([tmp_path], skip_broken=False), Options())
    told = {each.claim: each.support for each in headline(found)}
    assert told["The arms had different lengths"] == "views=2 900 steps; views=1 300 steps"


def test_lengths_that_differ_only_between_scenes_are_not_reported(tmp_path):
    for views in (1, 2):
        for seed in range(4):
            steps = 300 * (1 + seed % 2)
            run = RunFolder(
                f"place {seed % 2}", seed, 20.0 + views, views_per_step=views, steps=steps
            )
            run.write(tmp_path / f"{views}-{seed}")
    found = compared(read_runs([tmp_path], skip_broken=False), Options())
    assert not any("lengths" in each.claim for each in headline(found))
