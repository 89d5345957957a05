"""`python -m ocnf_data` is `ocnf-data`."""

from ocnf_data.cli import main

if __name__ == "__main__":
    main()
