"""``python -m piezojax.export``; ``--help`` lists its options."""

from .cli.export import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.export")
