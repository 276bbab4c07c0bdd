"""``python -m predmapnet``: the installed command."""

from importlib.metadata import entry_points

if __name__ == "__main__":
    (command,) = entry_points(group="console_scripts", name="predmapnet")
    command.load()()
