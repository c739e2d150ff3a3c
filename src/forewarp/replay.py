"""``python -m forewarp.replay <bundle>``: take a step again that met a number that is not finite."""

from forewarp.cli.replay import main

if __name__ == "__main__":
    main()
