"""A deep Q-network swings the inverted pendulum up, graded against dynamic programming."""

import qfolio

preset = qfolio.preset("fast", "pendulum", "dqn")
pendulum = qfolio.Pendulum()  # Gymnasium's Pendulum-v1 with eleven torques
run = qfolio.train(pendulum, preset.build(), episodes=preset.episodes, seeds=4)

grade = run.grade()
print(f"best mean return, by dynamic programming: {grade['optimum']:.1f}")
seeds = zip(grade["return_per_seed"], grade["regret_per_seed"], strict=True)
for seed, (mean_return, regret) in enumerate(seeds):
    print(f"seed {seed}: mean return {mean_return:.1f}, regret {regret:.1%}")
