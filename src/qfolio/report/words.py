"""Names and descriptions of tasks and agents in reports."""

from typing import NamedTuple

from qfolio.core.registry import GYM, short


class Words(NamedTuple):
    """What reports say about a task; empty where there is nothing to say."""

    where: str  # for the title: "DQN on the pendulum"
    about: str = ""
    meaning: str = ""  # definition of a return, unless it is the plain sum of rewards
    rule: str = ""  # the meaning of its rule's numbers
    scene: str = "{}"  # format of a scene's name


_WEIGHT_WANTED = "Each number is the target weight, given a weight held."

TASKS = {
    "pendulum": Words("on the pendulum"),
    "pendulum/grid": Words("on the pendulum seen through a grid"),
    "pendulum/hidden": Words("on the pendulum without its velocity"),
    "catch": Words("at catching a ball among decoys"),
    "finite/cliff": Words("at the cliff"),
    "finite/frozen-lake": Words("on the frozen lake"),
    "finite/random": Words("on a random finite process"),
    "market/kelly": Words(
        "on Kelly’s bet",
        "A repeated bet with good odds. The best policy always stakes the same fraction of the "
        "wealth (Kelly, 1956).",
        rule="The fraction is the share of the wealth at stake.",
    ),
    "market/merton": Words(
        "in Merton’s market",
        "Three assets and cash with the same return distribution at every step. The best weights "
        "therefore never change (Merton, 1969), and here one of the assets is not worth holding.",
        rule="The rest of the wealth is held in cash.",
    ),
    "market/regime": Words(
        "in a market of good and bad times",
        "One asset rises in good times and falls in bad ones, and trading costs. The best policy "
        "is all in or all out, and switches only if that earns more than it costs.",
        rule=_WEIGHT_WANTED,
        scene="{} times",
    ),
    "market/ar1": Words(
        "in a market with a signal",
        "A slowly fading signal predicts the return of one asset, and trading costs. The best "
        "policy, computed for weights in tenths, trades only if the signal is worth the cost, and "
        "otherwise keeps its holding.",
        rule=f"{_WEIGHT_WANTED} Signals are in standard deviations.",
        scene="signal {}",
    ),
    "market/no-trade": Words(
        "in a market with a no-trade region",
        "One asset grows faster than cash, and trading costs. The best policy does nothing inside "
        "a region of weights; outside of it, it trades just to the nearest edge.",
        "Each step counts with its expected growth, so that results do not depend on luck in "
        "prices.",
        rule="Low and high are the edges of the region: a holder of too little buys up to low, and "
        "a holder of too much sells down to high.",
    ),
    "market/garleanu-pedersen": Words(
        "in the market of Gârleanu and Pedersen",
        "A fading signal predicts the return of one asset, and costs grow with the square of a "
        "trade. The best policy therefore trades only part of the way to its aim (Gârleanu and "
        "Pedersen, 2013).",
        "It is the discounted sum of a position's gains, minus its risk and the costs of trading.",
        rule="The target is a sum of two parts. The coefficient of the position held is one minus "
        "the trading rate; the other is that of the factor, the signal.",
    ),
    "market/signals": Words(
        "in a market of several signals",
        "Four signals that fade at different rates predict the returns of three assets, and costs "
        "grow with the square of a trade, more so where liquidity is low. The best policy trades "
        "part of the way to its aim, slower in some portfolios than in others (Gârleanu and "
        "Pedersen, 2013). The figure shows the first asset, with nothing in the others.",
        "It is the discounted sum of the positions’ gains, minus their risk and the costs of "
        "trading.",
        rule="Each asset’s target is a sum over the positions held and the factors, the signals; "
        "these are their coefficients.",
        scene="factor 1 at {}",
    ),
    "market/leverage": Words(
        "in a market with leverage",
        "Three assets and cash with the same return distribution at every step, of which any may "
        "be sold short, and borrowing costs more than lending earns. The best weights never change "
        "(Merton, 1969): bold investors borrow, careful ones lend, and those between do neither.",
        "It is the sum of the steps’ utilities.",
        rule="A negative weight is sold short, or borrowed in the case of cash.",
    ),
    "market/liquidation": Words(
        "in a sale that moves the price",
        "A position must be sold within a few steps. A fast sale lowers the price, a slow one is "
        "exposed to it for longer. The best policy sells a share of what is left that depends on "
        "the time that remains (Almgren and Chriss, 2000).",
        "It is minus the expected shortfall and, weighted by the risk aversion, its variance, in "
        "million dollars.",
        rule="Each number is what is left of a position of one million shares.",
    ),
}
"""The texts of each task, by its name."""

AGENTS = {
    "dqn": "DQN",
    "pathwise": "Pathwise gradients",
    "q-learning": "Q-learning",
    "sarsa": "SARSA",
    "expected-sarsa": "Expected SARSA",
    "double-q": "Double Q-learning",
    "dyna-q": "Dyna-Q",
    "reinforce": "REINFORCE",
    "a2c": "A2C",
    "ppo": "PPO",
    "ddpg": "DDPG",
    "td3": "TD3",
    "sac": "SAC",
    "mbpo": "MBPO",
}
"""The name of each agent in reports."""


def words_of(task: str) -> Words:
    """The texts of a task; for one that is not registered, only its name."""
    return TASKS.get(task, Words(f"on {short(task.removeprefix(GYM))}"))


def agent_name(agent: str) -> str:
    """An agent's name in reports; for one that is not qfolio's, the name of its class."""
    return AGENTS.get(agent, short(agent))
