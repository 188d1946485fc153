"""MkDocs hooks: pages generated from the code, and conversion of links and formulas.

Generated: the pages `FILES`, one page per task (clip, sizes, observation, rewards, parameters) with
an overview, the tables that end settings.md, and the pages reference/MODULE.md in the navigation of
mkdocs.yml. LaTeX becomes MathML. Links to modules lead to their reference pages, other links to
files outside docs/ to the repository's address, `[project.urls]` in pyproject.toml. If it is not
set they become paths: the built site then needs neither the repository nor another host. The page
of `mqe play-site` is part of the site if it is in build/play; otherwise the site says how to build
it.
"""

import contextlib
import functools
import io
import itertools
import posixpath
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import griffe
import latex2mathml.converter
from mkdocs.structure.files import File

from mqe_jax.envs.facts import Field
from mqe_jax.policies import zoo

ROOT = Path(__file__).parents[1]
PLAY = ROOT / "build" / "play"
"""Folder of the page of `mqe play-site`."""
FILES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md"}
"""Files of the repository that are pages of the site."""
SETTINGS = {
    "index.md": "hide: [toc]",
    "tasks/": "search: {boost: 0.3}",
    "reference/": "search: {boost: 0.3}",
}
"""Settings of generated pages by the start of their path. The search lists the guides first."""


def on_files(files: Any, config: Any) -> Any:
    """Adds the generated pages, and the files of the page of `mqe play-site`."""
    modules = {path: f"mqe_jax.{Path(path).stem}" for path in _reference(config)}
    made = pages()
    for path, module in modules.items():
        made[path] = reference_page(module, {*modules.values()})
    for path, content in made.items():
        settings = [text for start, text in SETTINGS.items() if path.startswith(start)]
        head = "".join(f"---\n{text}\n---\n" for text in settings)
        files.append(File.generated(config, path, content=head + content))
    if _playable():
        for file in filter(Path.is_file, PLAY.rglob("*")):
            path = f"play/{file.relative_to(PLAY).as_posix()}"
            files.append(File.generated(config, path, abs_src_path=str(file)))
    return files


def _reference(config: Any) -> list[str]:
    """Returns the reference pages in the navigation."""
    named = "API reference"
    (pages,) = (section[named] for section in config["nav"] if named in section)
    return pages


def repository() -> str:
    """Returns the repository's address, `[project.urls]` in pyproject.toml; empty if missing."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project.get("urls", {}).get("Repository", "").rstrip("/")


def on_config(config: Any) -> Any:
    """Sets the repository's address, from which the theme makes the link in the header."""
    address = repository()
    if address:
        config["repo_url"] = address
        config["repo_name"] = "/".join(address.split("/")[-2:])
    return config


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Converts links and formulas of a page; adds the link to play and the tables of settings."""
    if page.file.src_uri == "play.md":
        markdown = play_link(markdown, _playable())
    if page.file.src_uri == "settings.md":
        markdown = f"{markdown}\n{all_settings()}"
    folder = posixpath.dirname(page.file.src_uri)
    return formulas(links(markdown, repository(), folder, _reference(config)))


def links(markdown: str, address: str = "", folder: str = "", reference: Sequence[str] = ()) -> str:
    """Leads links to files outside docs/ to the repository's address.

    Links to modules lead to their pages of the reference. The page is in a folder of docs/.
    Notebooks get links to Colab and Kaggle too, if the address is
    on GitHub. Without an address links become the file's name and path.
    """

    def resolve(match: re.Match[str]) -> str:
        text, path = match.groups()
        path = posixpath.normpath(posixpath.join("docs", folder, "..", path))
        if path.startswith("docs/"):
            return match.group(0)
        name, mark, heading = path.partition("#")
        if name in FILES:
            return f"[{text}]({posixpath.relpath(FILES[name], folder or '.')}{mark}{heading})"
        module = re.sub(r"(/__init__)?\.py$", "", name).removeprefix("mqe_jax/").replace("/", ".")
        if f"reference/{module}.md" in reference:
            return f"[{text}]({posixpath.relpath(f'reference/{module}.md', folder or '.')})"
        if not address:
            named = path.endswith(text.replace("\\", "").rstrip("/"))
            return text if named else f"{text} (`{path}`)"
        link = f"[{text}]({address}/blob/main/{path})"
        hub = address.partition("https://github.com/")[2]
        colab = f"https://colab.research.google.com/github/{hub}/blob/main/{path}"
        kaggle = f"https://kaggle.com/kernels/welcome?src={address}/blob/main/{path}"
        opened = f" (open in [Colab]({colab}), [Kaggle]({kaggle}))"
        return link + opened if hub and path.endswith(".ipynb") else link

    return re.sub(r"(?<!!)\[([^\[\]\n]+)\]\(\.\./([^)\s]+)\)", resolve, markdown)


def play_link(markdown: str, present: bool) -> str:
    """Puts the link to the page of `mqe play-site` below the title.

    If the page is missing, the text says how to build it.
    """
    text = (
        "This copy of the documentation was built without the page: run `make docs`, or the "
        "commands below."
    )
    if present:
        text = "**[Open the page](play/index.html)**"
    title, _, rest = markdown.partition("\n")
    return f"{title}\n\n{text}\n{rest}"


def _playable() -> bool:
    return (PLAY / "site.json").is_file()


def formulas(markdown: str) -> str:
    """Replaces $$...$$ and $...$ outside of code by MathML."""

    def block(match: re.Match[str]) -> str:
        latex = match.group(1).replace("\n", " ")
        return f"\n{latex2mathml.converter.convert(latex, display='block')}\n"

    def inline(match: re.Match[str]) -> str:
        return latex2mathml.converter.convert(match.group(1))

    parts = re.split(r"(```.*?```|`[^`\n]*`)", markdown, flags=re.DOTALL)
    for index in range(0, len(parts), 2):
        text = re.sub(r"\$\$(.+?)\$\$", block, parts[index], flags=re.DOTALL)
        parts[index] = re.sub(r"\$([^$\n]+?)\$", inline, text)
    return "".join(parts)


def pages() -> dict[str, str]:
    """Returns the generated pages by path."""
    with contextlib.redirect_stdout(io.StringIO()):  # MJX prints a note about a missing warp-lang
        from mqe_jax.envs import TASKS
    made = {f"tasks/{name}.md": task_page(task) for name, task in TASKS.items()}
    made["tasks/index.md"] = overview(TASKS)
    made |= {path: front((ROOT / name).read_text(encoding="utf-8")) for name, path in FILES.items()}
    return made


def reference_page(module: str, pages: set[str]) -> str:
    """Returns the page of a module, without what it only exports from modules that have pages."""
    members = _package()[module.partition(".")[2]].members.values()
    elsewhere = [
        x.name for x in members if x.is_alias and x.target_path.rpartition(".")[0] in pages
    ]
    filters = ["!^_", f"!^({'|'.join(elsewhere)})$"]
    return f"# {module}\n\n::: {module}\n    options:\n      filters: {filters}\n"


def front(readme: str) -> str:
    """Returns a file of the repository as a page of docs/.

    Its links are as from docs/, and tasks lead to their pages.
    """
    page = re.sub(r"\]\((?![a-z]+:)([^)]+)\)", r"](../\1)", readme).replace("](../docs/", "](")
    return re.sub(
        r"^(\| .*) `(go1[\w-]+)` \|", r"\1 [`\2`](tasks/\2.md) |", page, flags=re.MULTILINE
    )


def overview(tasks: Mapping[str, Any]) -> str:
    """Returns the page that shows all tasks, as a gallery."""
    kinds: dict[str, list[str]] = {"Cooperative": [], "Competitive": [], "For tests": []}
    for name, task in tasks.items():
        env = task(num_envs=1, impl="c")
        kind = "Competitive" if len(env.teams) > 1 else "Cooperative"
        if name == "go1plane":
            kind = "For tests"
        clip = _clip(name)
        image = f"[![{task.title}: {task.aim}]({clip})]({name}.md)<br>" if clip else ""
        robots = " vs ".join(str(len(team)) for team in env.teams)
        sizes = (
            f"{robots} robots, {env.observation_size} numbers observed by each, "
            f"{env.params.episode_length:g} s"
        )
        kinds[kind].append(f"- {image}[**{task.title}**]({name}.md) `{name}`: {sizes}")
    parts = [
        "# Tasks\n\nEach page has a task's observation, rewards and parameters, which are read "
        "from the code."
    ]
    for kind, items in kinds.items():
        gallery = "\n".join(items)
        parts.append(f'## {kind}\n\n<div class="gallery" markdown>\n\n{gallery}\n\n</div>')
    return "\n\n".join(parts) + "\n"


def all_settings() -> str:
    """Returns tables of all settings of a training, and of the parameters that tasks share."""
    from mqe_jax.envs.facts import fields
    from mqe_jax.envs.params import TaskParams
    from mqe_jax.envs.registry import SHIPPED
    from mqe_jax.presets import resolve
    from mqe_jax.train.config import TrainConfig
    from mqe_jax.train.networks import NETWORKS

    columns = ["total_steps", "num_envs", "ppo.gamma", "ppo.entropy_coef", "imitation.teacher"]
    tasks = []
    for name in SHIPPED:
        values = {x.name: _shown(x.value) for x in fields(resolve(name))}
        tasks.append([f"[`{name}`](tasks/{name}.md)", *(values[column] for column in columns)])
    every = [x for x in fields(TrainConfig()) if x.name != "task"]
    settings = sorted(every, key=lambda x: "." in x.name)  # general ones first
    sections = [
        "## Default settings of each task",
        _rows(["task", *(f"`{name}`" for name in columns)], tasks),
        "## All settings of a training",
        "The defaults are those of a settings file that leaves them out.",
        _table(settings, "default"),
    ]
    usual = {x.name for x in settings}
    for name in sorted(NETWORKS.keys() - {TrainConfig().network.name}):
        own = [x for x in fields(NETWORKS[name](), "network.") if x.name not in usual]
        sections += [f"### With `network.name: {name}`", _table(own, "default")]
    sections += [
        "## Parameters of all tasks",
        "A task may have other defaults: see [its page](tasks/index.md). "
        "[Ranges of `randomization`](reference/envs.randomization.md) have names of their own.",
        _table(fields(TaskParams()), "default"),
    ]
    return "\n\n".join(sections) + "\n"


def task_page(task: Any) -> str:
    """Returns the page of a task."""
    from mqe_jax.cli.task_card import describe
    from mqe_jax.envs import SCRIPTED
    from mqe_jax.envs.facts import facts

    env = task(num_envs=1, impl="c")
    name = task.name
    about = facts(env)
    policy = "scripted" if name in SCRIPTED else "forward"
    if name in zoo.names():
        policy = "shipped"
    match = len(env.teams) > 1
    flags = " --opponent scripted" if match else ""
    against = " against the scripted one" if match else ""
    media = []
    if _clip(name):
        success = f"A typical success of the {policy} policy{against}"
        media.append(f"![{task.title}: {task.aim}]({_clip(name)})")
        media.append(f"{success}: [how good it is](../results/strength.md).")
    commands = {
        f"mqe render {name}{flags} -o clip.webp": f"a clip of the {policy} policy",
        f"mqe view {name}{flags}": "live, in the browser",
    }
    for training in describe(env)["training"]:
        millions = f"{training['steps'] / 1e6:g} M steps"
        commands[training["command"]] = f"{millions} of {training['environments']} environments"
    term = about.rewards[0]
    twice = f"--set rewards.{term.name}={2 * term.value:g}"
    commands[f"mqe train {name} {twice}"] = "with twice the weight of a reward"
    ranges = [f"`{name}` {text}" for name, text in about.actions.items()]
    width = max(map(len, commands))
    lines = "\n".join(f"{command:{width}}  # {text}" for command, text in commands.items())
    lead = [
        f"- Robots: {' vs '.join(str(len(team)) for team in env.teams)}.",
        f"- Action: commands of the skill `{env.params.skill}` ({', '.join(ranges)}). "
        "With control `position` or `torque`, a number for each joint.",
    ]
    rows = [
        f"| `{b.name}` | {b.width} | {b.meaning or ''} |" for b in env.observation_layout.blocks
    ]
    sections = [
        f"# {task.title} (`{name}`)",
        task.aim,
        *media,
        f"```bash\n{lines}\n```",
        "[What a training reaches](../results/settings.md). [All settings](../settings.md).",
        "\n".join([*lead, about.about]),
        f"## Observation of an agent\n\n{env.observation_size} numbers:",
        "| block | width | meaning |\n|---|---|---|\n" + "\n".join(rows),
        f"A critic may also see the privileged observation, {env.privileged_observation_size} "
        "numbers.",
        "## Reward terms\n\n" + _table(about.rewards, "weight"),
        "Set a weight with `--set rewards.NAME=VALUE` or `make(task, rewards={...})`. Terms whose "
        "weight is 0 are for [training](../shaping.md).",
        "## Parameters\n\n" + _table(about.parameters, "default"),
        "Set one with `--set NAME=VALUE` or `make(task, NAME=VALUE)`. "
        "All tasks share [further parameters](../settings.md#parameters-of-all-tasks).",
    ]
    return "\n\n".join(sections) + "\n"


def _clip(name: str) -> str | None:
    return f"../clips/{name}.webp" if (ROOT / "docs" / "clips" / f"{name}.webp").is_file() else None


def _table(fields: Iterable[Field], column: str) -> str:
    """Returns a table of settings, parameters or reward terms."""
    rows = [[f"`{x.name}`", _shown(x.value), x.allowed, _cell(x.meaning)] for x in fields]
    return _rows(["name", column, "allowed", "meaning"], rows)


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table; a column without content, such as of what is allowed, is left out."""
    lines = [head, ["---"] * len(head), *rows]
    kept = [any(row[i] for row in lines[2:]) for i in range(len(head))]
    return "\n".join(f"| {' | '.join(itertools.compress(line, kept))} |" for line in lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


@functools.cache
def _package() -> Any:
    return griffe.load("mqe_jax", search_paths=[ROOT])


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if type(value) is int:
        return f"{value:_}"
    return f"`{list(value) if isinstance(value, tuple) else value}`"
