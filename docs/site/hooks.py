"""What MkDocs is told beside mkdocs.yml: the front page, the README as the guide, a page of reference for every wing.

Links to the README lead to the guide; those to other files of the repository become their names.
"""

from __future__ import annotations

import ast
import os
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PACKAGES = ("rsgen", "rstrack")
# Mark of a picture, text, target, anchor.
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]*)(#[^)\s]*)?\)")


def slug(title: str, separator: str) -> str:
    """The anchor of a heading as GitHub makes it, so that links hold in both places."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", separator)


def wings(package: str) -> list[str]:
    """Names of a package's wings, and of the modules beside them that are documented."""
    folder = ROOT / package
    found = [path.parent.name for path in folder.glob("*/__init__.py")]
    return sorted(found + [path.stem for path in folder.glob("*.py") if not path.stem.startswith("_")])


def modules(package: str, wing: str) -> list[str]:
    """Full names of the modules of a wing, itself first where it says what it is for."""
    path = ROOT / package / wing
    files = [path.with_suffix(".py")] if not path.is_dir() else sorted(path.rglob("*.py"))
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for file in files]
    return sorted(name for name in names if not name.rpartition(".")[2].startswith("_"))


def reference(package: str, wing: str) -> str:
    """A page of the reference: every module of the wing with its public functions and classes."""
    alone = "\n    options:\n      members: false"
    blocks = [f"::: {name}" + (alone if is_wing(name) else "") for name in modules(package, wing)]
    return f"# {package}.{wing}\n\n" + "\n\n".join(blocks) + "\n"


def is_wing(name: str) -> bool:
    """Whether a module is a folder, whose own page lists what is in it."""
    return (ROOT / name.replace(".", "/")).is_dir()


def face(package: str) -> str:
    """The page of what `import rsgen` or `import rstrack` offers."""
    tree = ast.parse((ROOT / package / "__init__.py").read_text())
    homes = {
        alias.name: f"{node.module}.{alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(package)
        for alias in node.names
    }
    summary = (ast.get_docstring(tree) or "").partition("\n")[0]
    return f"# {package}\n\n{summary}\n\n" + "\n\n".join(f"::: {name}" for name in homes.values()) + "\n"


def front_page() -> str:
    """landing.md with what the README shows of the records: its headline, its table and the line that explains it."""
    readme = _LINK.sub(lambda match: _led(match, ROOT, ROOT / "docs"), (ROOT / "README.md").read_text())
    blocks = dict(re.findall(r"<!-- (headline|results):begin.*?-->\n(.*?)<!-- \1:end -->", readme, flags=re.S))
    shown = [line for line in blocks["results"].splitlines() if line.startswith(("|", "Cells"))]
    blocks["results"] = "\n".join(shown).replace("\n|", "\n\n|", 1)
    text = (ROOT / "docs/site/landing.md").read_text()
    return re.sub(r"{{(\w+)}}", lambda match: blocks[match[1]].strip(), text)


def on_config(config: Any) -> Any:
    """The reference's place in the navigation, and anchors as GitHub has them."""
    entries = [
        {package: [f"reference/{package}/index.md", *(f"reference/{package}/{wing}.md" for wing in wings(package))]}
        for package in PACKAGES
    ]
    for entry in config.nav:
        if "Reference" in entry:
            entry["Reference"] = entries
    config.mdx_configs["toc"] |= {"slugify": slug}
    return config


def on_files(files: Any, config: Any) -> Any:
    """The front page, the guide and the reference, which lie in no folder."""
    from mkdocs.structure.files import File  # here, so that the rest is tested without MkDocs

    pages = {"index.md": front_page(), "guide.md": (ROOT / "README.md").read_text()}
    for package in PACKAGES:
        pages[f"reference/{package}/index.md"] = face(package)
        pages |= {f"reference/{package}/{wing}.md": reference(package, wing) for wing in wings(package)}
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links of the guide begin in the repository's root, those of the documents in docs/; examples are shown."""
    source = page.file.src_uri
    if source.startswith("reference/") or source == "index.md":
        return markdown
    here = ROOT if source == "guide.md" else (ROOT / "docs" / source).parent
    if source == "examples/README.md":
        scripts = sorted((ROOT / "docs/examples").glob("*.py"))
        markdown += "".join(f"\n## {path.name}\n\n```python\n{path.read_text()}```\n" for path in scripts)
    return _LINK.sub(lambda match: _led(match, here, (ROOT / "docs" / source).parent), markdown)


def _led(match: re.Match[str], here: Path, page: Path) -> str:
    mark, text, target, anchor = match[1], match[2], match[3], match[4] or ""
    if not target or "://" in target:
        return match[0]
    path = (here / target).resolve()
    if path == ROOT / "README.md":
        path = ROOT / "docs/guide.md"
    elif not path.is_relative_to(ROOT / "docs"):
        return text
    return f"{mark}[{text}]({Path(os.path.relpath(path, page)).as_posix()}{anchor})"
