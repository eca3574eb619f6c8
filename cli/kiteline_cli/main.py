"""placeholder while the package is installed"""


def run() -> None:
    print("kiteline")
