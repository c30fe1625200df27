"""Run the notebooks and store them with their outputs: `python notebooks/run.py [NAME.ipynb …]`.

What only a running kernel can show (cells tagged "live") is not stored; a photograph stands for it
(`make_pictures.py`). Of the other notebooks the last picture is written to `pictures`, for the
gallery. A digest of the code that was run lets the tests see when a notebook has to be run again.
"""

from __future__ import annotations

import hashlib
import sys
from base64 import b64decode
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent


def digest(notebook: nbformat.NotebookNode) -> str:
    """SHA-256 of all code of a notebook."""
    code = (cell.source for cell in notebook.cells if cell.cell_type == "code")
    return hashlib.sha256("\n\n".join(code).encode()).hexdigest()


def is_compiling(output: nbformat.NotebookNode) -> bool:
    """Whether an output only says that the solver is compiled, once after installation."""
    return output.get("name") == "stderr" and output.text.startswith("foamfit: compiling")


def run(path: Path) -> None:
    """Run a notebook in its folder and write it back; an error in a cell is raised."""
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, kernel_name="python3", timeout=600, resources=resources).execute()
    live = False
    for cell in notebook.cells:
        cell.metadata = {key: cell.metadata[key] for key in ("tags",) if key in cell.metadata}
        if "live" in cell.metadata.get("tags", ()):
            cell.outputs, live = [], True
        if cell.cell_type == "code":
            cell.outputs = [o for o in cell.outputs if not is_compiling(o)]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    language = {"name": "python"}
    done = {"kernelspec": kernel, "language_info": language, "run": digest(notebook)}
    notebook.metadata = done
    nbformat.write(notebook, path)
    outputs = (output for cell in notebook.cells for output in cell.get("outputs", ()))
    shown = [o.data["image/png"] for o in outputs if "image/png" in o.get("data", {})]
    if not live:
        (HERE / "pictures" / f"{path.stem}.png").write_bytes(b64decode(shown[-1]))
    print(f"{path.name}  {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    for path in [Path(name) for name in sys.argv[1:]] or sorted(HERE.glob("*.ipynb")):
        run(path)
