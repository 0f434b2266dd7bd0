"""`python -m turbogs_plugin` is the `turbogs` command."""

from turbogs_plugin.cli import main

if __name__ == "__main__":
    main()
