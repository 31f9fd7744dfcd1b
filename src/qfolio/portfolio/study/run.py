"""A study: one frozen configuration, backtested on many price tables, and the evidence pooled.

Each table is an ordinary backtest in a folder of its own, and so is each variant of a table: the
same agents trained and tested at another lag or cost. All of them are written before the first is
trained, so that nothing is chosen after a result is known.
"""

import contextlib
import itertools
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import msgspec

from qfolio.core import devices
from qfolio.core.errors import (
    QfolioError,
    TooFewRowsError,
    require_list,
    require_type,
    require_whole,
)
from qfolio.core.files import locked, new_folder, path_of
from qfolio.core.mdp import Agent
from qfolio.core.notebook import card
from qfolio.core.registry import again
from qfolio.core.text import amount, near
from qfolio.experiments.executor import Executor
from qfolio.experiments.interrupts import interruptible
from qfolio.experiments.log import Log, add_result
from qfolio.experiments.machines.choice import on
from qfolio.experiments.presets import Preset
from qfolio.portfolio.backtest.attribution.explain import explain
from qfolio.portfolio.backtest.attribution.why import Why
from qfolio.portfolio.backtest.folder import MOST_TRIALS
from qfolio.portfolio.backtest.folds import parse_length, require_fold
from qfolio.portfolio.backtest.replay import Entry
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.statistics.assessment import Assessment
from qfolio.portfolio.backtest.trading_terms import PROPORTIONAL, TradingTerms
from qfolio.portfolio.backtest.writing import write_tables
from qfolio.portfolio.prices.table import Prices, describe, load
from qfolio.portfolio.study.folder import (
    NAME,
    Look,
    Result,
    StudyConfig,
    StudyFolder,
    TableConfig,
    Variant,
)
from qfolio.portfolio.study.summary import summarize
from qfolio.portfolio.study.training import Listen, Trainings, of_table
from qfolio.portfolio.study.twins import twins
from qfolio.portfolio.study.verdict import decimal, growth_text

Report = Callable[[Backtest, dict[str, Entry], Assessment, list[str], Why | None], None]


class Study:
    """One configuration of agents, backtested on many price tables.

    ``create`` or ``open`` makes one, ``run`` does what is missing and ``result`` pools it.

    interrupted: whether Ctrl-C stopped the last ``run``.
    """

    def __init__(
        self, config: StudyConfig, folder: Path, agents: Mapping[str, Agent] | None = None
    ) -> None:
        self.config, self.folder, self._files = config, folder, StudyFolder(folder)
        self._agents = dict(agents or {})
        self.interrupted = False

    @classmethod
    def create(
        cls,
        tables: Mapping[str, Any],
        agents: Mapping[str, Preset | Agent],
        *,
        lags: Sequence[int] = (1,),
        costs: Sequence[float] = (0.001,),
        train: str = "5y",
        test: str = "1y",
        trials: int = 0,
        after: Sequence[Path | str] = (),
        command: str = "",
        out: Path | str,
        **options: Any,
    ) -> "Study":
        """A study before its first backtest.

        Tables that are too short for one whole fold, a test of five rows, or an agent's
        window and episodes are left out (``config.left_out`` says why).

        Args:
            tables: Price tables by name, or anything else that ``load_prices`` reads; names become
                folders.
            agents: The agents to train, by name, as ``Backtest.create`` takes them.
            lags, costs: Every lag is combined with every cost (a fraction of the value traded); the
                first of each make the main variant.
            train, test: Lengths such as "5y" or "500d" (d counts rows).
            trials: Earlier looks at each of the tables.
            after: Folders of earlier studies; their looks at the same tables are counted, too, and
                those that they were told of by ``trials``.
            command: The command that started it, for the reports.
            out: A new or empty folder.
            options: Further arguments of ``Backtest.create``: expanding, seeds, baselines, ….

        Raises:
            QfolioError: A name or a table is given twice, all tables are too short, several costs
                are given although a mandate or a cost model sets it, or a backtest refuses its
                arguments.
        """
        wanted = 'a dictionary of tables by name, such as {"us": qfolio.load_prices("us.csv")}'
        require_type("tables", tables, Mapping, wanted)
        require_list("lags", lags, Integral, "a list of whole numbers, such as [1, 2]")
        require_list("costs", costs, Real, "a list of numbers, such as [0.001, 0.005]")
        require_list("after", after, str | os.PathLike, 'a list of folders, such as ["runs/study"]')
        require_whole("trials", trials, 0, MOST_TRIALS)
        require_type("command", command, str, "text")
        place = path_of("out", out)
        tables = {name: load(table) for name, table in tables.items()}
        for length in (train, test):  # or it would be the reason why tables are left out
            parse_length(length)
        costs = _charged(costs, options)
        variants = [Variant(int(lag), float(cost)) for lag, cost in itertools.product(lags, costs)]
        _require_plan(tables, variants)
        studies = [StudyFolder(path_of("after", folder)).read() for folder in after]
        looked = (look for study in studies for look in (*study.earlier, *study.looks))
        earlier = list(dict.fromkeys(looked))
        looks = {
            name: int(trials) + _told(studies, table.digest) + _count(earlier, table.digest)
            for name, table in tables.items()
        }
        left_out = {}
        with new_folder(place) as folder:
            files = StudyFolder(folder)
            for name, table in tables.items():
                with of_table(name):
                    try:
                        require_fold(table.dates, train, test, max(lags, default=1))
                        for variant in variants:
                            Backtest.create(
                                table,
                                agents,
                                train=train,
                                test=test,
                                lag=variant.lag,
                                cost=variant.cost,
                                trials=looks[name],
                                command=command,
                                out=files.place(name, variant),
                                **options,
                            )
                    except TooFewRowsError as error:
                        left_out[name] = str(error)
                        shutil.rmtree(files.table(name), ignore_errors=True)
            if len(left_out) == len(tables):
                reasons = (f"{name} is too short: {why}" for name, why in left_out.items())
                raise QfolioError(" ".join(reasons))
            config = StudyConfig(
                tables={
                    name: _table_config(table, looks[name])
                    for name, table in tables.items()
                    if name not in left_out
                },
                left_out=left_out,
                twins=twins({n: table for n, table in tables.items() if n not in left_out}),
                variants=variants,
                agents=list(agents),
                train=train,
                test=test,
                command=command,
                earlier=earlier,
                **devices.circumstances(),
            )
            files.write(config)
        own = {name: agent for name, agent in agents.items() if isinstance(agent, Agent)}
        return cls(config, place, own)

    @classmethod
    def open(cls, folder: Path | str, agents: Mapping[str, Agent] | None = None) -> "Study":
        """A study as its last finished group of folds left it.

        agents: by name, those that are not registered with qfolio.
        """
        place = path_of("folder", folder)
        return cls(StudyFolder(place).read(), place, agents)

    def __repr__(self) -> str:
        tables = amount(len(self.config.tables), "table")
        done = f"{len(self.config.looks)} of {len(self.places)} backtests finished"
        return f"<Study: {', '.join(self.config.agents)} on {tables}, {done}, in {self.folder}>"

    def _repr_html_(self) -> str:
        config = self.config
        agents = config.result.variants[0].agents if config.result else {}
        rows = [
            (name, growth_text(each.growth), decimal(each.z), each.finding or "")
            for name, each in ((name, pools.to_reference) for name, pools in agents.items())
        ]
        facts = [
            amount(len(config.tables), "table"),
            f"{len(config.looks)} of {amount(len(self.places), 'backtest')} finished",
            str(self.folder),
        ]
        pooled = "pooled, " if len(config.tables) > 1 else ""
        header = (f"{pooled}a year, net", "less the benchmark", "z", "")
        return card(f"Study of {' and '.join(config.agents)}", facts, header, rows)

    @property
    def places(self) -> list[tuple[str, Variant]]:
        """Every table and variant, in the order in which they run: the main variant first."""
        return [(name, each) for each in self.config.variants for name in self.config.tables]

    def finished(self, table: str, variant: Variant) -> bool:
        """Whether the result on a table was computed, which is a look at it."""
        return any(
            (look.table, look.lag, look.cost) == (table, variant.lag, variant.cost)
            for look in self.config.looks
        )

    def backtest(self, table: str, variant: Variant | None = None) -> Backtest:
        """The backtest of a table (default: in the main variant)."""
        if table not in self.config.tables:
            known = near(table, self.config.tables)
            raise QfolioError(f"The study has no table {table!r}; {known}")
        place = self._files.place(table, variant or self.config.variants[0])
        return Backtest.open(place, self._agents)

    @property
    def parts(self) -> list[object]:
        """Those of each backtest, which may be of a user's own modules."""
        return self.backtest(next(iter(self.config.tables))).parts

    def run(
        self,
        listen: Listen | None = None,
        report: Report | None = None,
        executor: Executor | str | None = None,
    ) -> None:
        """Runs every backtest that is not finished.

        A first Ctrl-C stops after the current chunk of training and sets ``interrupted``; finished
        groups of folds are kept.

        Args:
            listen: Called before the first job of each backtest; returns the ``listen`` of
                ``Backtest.run``.
            report: Called with each finished backtest, its entries, assessment, notes and, in the
                main variant, attributions, before it counts as finished.
            executor: Where training runs (default: in this process); see ``qfolio.on``.
        """
        executor = on(executor)
        missing = [place for place in self.places if not self.finished(*place)]
        if not missing:
            return
        with contextlib.ExitStack() as stack:
            stack.enter_context(locked(self.folder))
            log = stack.enter_context(Log(self.folder).opened(**self._about))
            trainings = Trainings(missing, self.backtest, executor, listen, log)
            for table, variant in missing:
                stack.enter_context(locked(self._files.place(table, variant)))
            stop = stack.enter_context(interruptible())
            finished = stack.enter_context(
                contextlib.closing(executor.map(trainings.jobs(), trainings.listeners))
            )
            for job, trained in finished:
                place = trainings.store(job, trained)
                if not (place.left or stop.is_set()):
                    self._conclude(place.table, place.variant, place.backtest, report)
            for table, variant in missing:  # those whose training was complete already
                if not (self.finished(table, variant) or stop.is_set()):
                    self._conclude(table, variant, self.backtest(table, variant), report)
            self.interrupted = stop.is_set() and not self._complete
            log.settle(self._complete)

    @property
    def _about(self) -> dict[str, Any]:
        """What the log says about the study."""
        config = self.config
        tables, variants = len(config.tables), len(config.variants)
        about = f"{amount(tables, 'table')}, {amount(variants, 'variant')}"
        return {"kind": config.kind, "task": about, "agents": config.agents}

    def _conclude(
        self, table: str, variant: Variant, backtest: Backtest, report: Report | None
    ) -> None:
        """Replays a backtest that has been trained, which is a look at its table."""
        with of_table(table):
            entries, notes = backtest.entries()
            assessment = backtest.assess(entries)
            why = explain(backtest, entries) if variant == self.config.variants[0] else None
            write_tables(backtest, entries, assessment, why)
            if report is not None:
                report(backtest, entries, assessment, notes, why)
        self._note(table, variant)

    def result(self) -> Result:
        """The pooled evidence; writes it into study.json and study.csv.

        Raises QfolioError if a backtest is not finished, or has gone on beyond its table.
        """
        config = self.config
        if not self._complete:
            resume = again("qfolio study --resume", self.folder, *self.parts)
            raise QfolioError(f"The study is not finished; continue with {resume}.")
        result = summarize(
            config,
            [
                {name: self._files.read_returns(name, each, config) for name in config.tables}
                for each in config.variants
            ],
        )
        self.config = msgspec.structs.replace(config, result=result)
        self._files.write(self.config)
        self._files.write_table(result)
        add_result(self.folder, _measures(result))
        return result

    @property
    def _complete(self) -> bool:
        return all(self.finished(*place) for place in self.places)

    def _note(self, table: str, variant: Variant) -> None:
        """Records a look, which marks the backtest as finished."""
        look = Look(
            study=self.config.started,
            table=table,
            digest=self.config.tables[table].digest,
            lag=variant.lag,
            cost=variant.cost,
            agents=tuple(self.config.agents),
        )
        order = [(name, each.lag, each.cost) for name, each in self.places]
        looks = [*self.config.looks, look]
        # In the order of the places, whichever was finished first.
        looks.sort(key=lambda look: order.index((look.table, look.lag, look.cost)))
        self.config = msgspec.structs.replace(self.config, looks=looks)
        self._files.write(self.config)


def _table_config(prices: Prices, trials: int) -> TableConfig:
    facts = describe(prices)
    kept = {key: facts[key] for key in ("source", "digest", "rows", "assets", "first", "last")}
    return TableConfig(**kept, note=str(facts["note"] or ""), trials=trials)


def _measures(result: Result) -> dict[str, dict[str, float | None]]:
    """What the log says of each agent: its active growth a year in the main variant, and z."""
    found = {name: pools.to_reference for name, pools in result.variants[0].agents.items()}
    return {
        name: {"active_growth": one.growth, "low": one.low, "high": one.high, "z": one.z}
        for name, one in found.items()
    }


def _count(looks: Sequence[Look], digest: str) -> int:
    return sum(len(look.agents) for look in looks if look.digest == digest)


def _told(studies: Sequence[StudyConfig], digest: str) -> int:
    """The looks at a table that earlier studies were told of by ``trials``.

    Several may have been told of the same ones, so the largest number counts.
    """
    told = (
        table.trials - _count(study.earlier, digest)
        for study in studies
        for table in study.tables.values()
        if table.digest == digest
    )
    return max(told, default=0)


def _charged(costs: Sequence[float], options: Mapping[str, Any]) -> list[float]:
    """The costs that backtests with these options will charge.

    Raises QfolioError if several are given, and the mandate or the cost model sets one for all.
    """
    mandate, model = options.get("mandate"), options.get("cost_model", PROPORTIONAL)
    charged = [TradingTerms.of(mandate, cost, model).cost for cost in costs]
    if len(set(costs)) > len(set(charged)):
        raise QfolioError(
            f"The mandate or the cost model sets a cost of {charged[0] * 1e4:g} bp, so a study "
            "cannot vary it; leave the cost out there, or give a single cost."
        )
    return charged


def _require_plan(tables: Mapping[str, Prices], variants: Sequence[Variant]) -> None:
    """Raises QfolioError if there is nothing to do, something is given twice, or a name is invalid.

    Names become folders.
    """
    if not (tables and variants):
        what = "table; name its file" if variants else "lag and one cost"
        raise QfolioError(f"A study needs at least one {what}.")
    names: dict[str, str] = {}
    for name, table in tables.items():
        if not re.fullmatch(NAME, name):
            raise QfolioError(f"A table is called {name!r}; use letters, digits, - and _.")
        if (twin := names.setdefault(table.digest, name)) != name:
            raise QfolioError(f"{twin} and {name} are the same table; give it once.")
    for variant in variants:
        if [each.name for each in variants].count(variant.name) > 1:  # a folder
            raise QfolioError(
                f"A lag of {variant.lag} with a cost of {variant.bps:g} bp is given twice."
            )
