"""The trainings of the pages, in the order of the site, write to different folders, and commands read existing ones."""

import argparse
import ast
import re
import shlex

import pytest
from pages import GENERATED, ROOT, navigation_pages

from crazysim.commands import training
from crazysim.commands.options import parse_pairs
from crazysim.lab.commands import live
from crazysim.train.config import TrainConfig

BLOCK = re.compile(r"^```(?P<language>sh(?=\n)|py|python)\b[^\n]*\n(?P<code>.*?)^```", re.DOTALL | re.MULTILINE)
"""Block of commands or of Python; a shell block with a title is a script."""


def default_folder(task):
    return f"out/{TrainConfig(task, 'ppo', 0, 1, {}, {}).title}"


def command_folders(code):
    """Yield the folder that a command of a shell block writes, whether it resumes, and the folder that it reads."""
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(dest="command")
    for module in (training, live):
        module.add_parsers(commands)
    for line in code.replace("\\\n", " ").splitlines():
        program, *arguments = shlex.split(line, comments=True) or [""]
        if program != "crazysim" or arguments[0] not in commands.choices:
            continue
        options = parser.parse_args(arguments)
        if getattr(options, "policies", None):
            yield from ((None, False, folder) for folder in options.policies)
        elif options.command != "train":
            yield None, False, options.policy if options.command == "live" else options.folder
        elif (
            options.task != "list" and not options.host_id and not options.check
        ):  # all hosts take part in the run of the first
            yield options.out or default_folder(options.task), options.resume, options.teacher


def python_folders(code):
    """Yield the same for ``train.run``, ``train.run_many`` and ``train.load_policy``, if their arguments are texts."""
    for call in (node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Call)):
        name, texts = ast.unparse(call.func), [x.value if isinstance(x, ast.Constant) else None for x in call.args]
        if name == "train.load_policy":
            yield None, False, texts[0]
        elif name in ("train.run", "train.run_many"):
            folder = texts[1] if len(texts) > 1 else texts[0] and default_folder(texts[0])
            yield folder, any(keyword.arg == "resume" for keyword in call.keywords), None


def complaints(pages):
    """Return the commands that would be refused if a reader ran all blocks of some pages in order.

    Args:
        pages: Text of each page by its name, in the order of the site.
    """
    written, result = {"any"}, []  # the policy of the package
    for name, text in pages.items():
        for block in BLOCK.finditer(text):
            folders = command_folders if block["language"] == "sh" else python_folders
            for new, resumes, read in folders(block["code"]):
                if new and (str(new) in written) != resumes:
                    result.append(f"{name}: {new} {'holds no run to resume' if resumes else 'holds a run already'}")
                if read and str(read) not in written:
                    result.append(f"{name}: {read} holds no run to read")
                written |= {str(new)} if new else set()
    return result


def test_no_training_of_the_pages_is_refused():
    sources = {page: ROOT / GENERATED.get(page, f"docs/{page}") for page in navigation_pages()}
    pages = {page: source.read_text() for page, source in sources.items() if source.exists()}
    assert sum(text.count("crazysim train") for text in pages.values()) > 20
    assert not (result := complaints(pages)), "\n".join(result)


@pytest.mark.parametrize(
    ("language", "code", "complaint"),
    [
        ("sh", "crazysim train hover", "holds a run already"),
        ("sh", "crazysim train track --seed 1 \\\n    --out out/hover", "holds a run already"),
        ("sh", "crazysim train mine.py:TwoHoops\ncrazysim train two_hoops", "two_hoops holds a run already"),
        ("sh", "crazysim train track --resume", "holds no run to resume"),
        ("sh", "crazysim train track --teacher out/track", "holds no run to read"),
        ("sh", "crazysim live --policy out/track", "holds no run to read"),
        ("py", 'train.run("hover", seed=1)', "holds a run already"),
        ("python", 'train.run("track", "out/hover")', "holds a run already"),
        ("python", 'train.load_policy("out/track")', "holds no run to read"),
        ("sh", "crazysim train hover --resume --iterations 160  # more", None),
        ("sh", "crazysim train hover --out out/a --host-id 0\ncrazysim train hover --out out/a --host-id 1", None),
        ("sh", "crazysim train track --out out/a\ncrazysim evaluate out/a", None),
    ],
)
def test_the_check_finds_refused_commands(language, code, complaint):
    result = complaints({"a.md": "```sh\ncrazysim train hover\n```\n", "b.md": f"```{language}\n{code}\n```\n"})
    assert len(result) == (complaint is not None)
    assert complaint is None or complaint in result[0]


def test_the_commands_of_the_page_are_the_recipes_teacher_and_student():
    parser = argparse.ArgumentParser()
    training.add_parsers(parser.add_subparsers())
    page = (ROOT / "docs/learn/sight.md").read_text().replace("\\\n", " ")
    teacher, student = re.findall(r"^crazysim (train race_by_camera .*--out out/race_\w+)$", page, re.MULTILINE)
    options = parser.parse_args(shlex.split(teacher))
    config = parse_pairs(options.config) | {"iterations": options.iterations}
    settings = {name: tuple(x) if isinstance(x, list) else x for name, x in parse_pairs(options.set).items()}
    chosen = TrainConfig.create(
        options.task, options.algorithm, n_worlds=options.worlds, options=settings, config=config
    )
    assert chosen == TrainConfig.create(options.task).teacher_config()
    assert parser.parse_args(shlex.split(student)).teacher == str(options.out)
