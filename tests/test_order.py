"""In which order files of tests begin."""

from tests.conftest import in_turn


def test_long_files_come_first_and_those_that_compute_and_that_wait_by_turns():
    given = [
        "acoustics/test_air.py",
        "clients/test_unity.py",
        "integration/test_page.py",
        "page/test_layout.py",
        "streaming/test_session.py",
        "test_order.py",
        "training/bundling/test_export.py",
        "training/bundling/test_noise.py",
        "training/models/test_naf.py",
        "training/simulation/test_rays.py",
    ]
    assert in_turn(given) == [
        "training/bundling/test_export.py",
        "page/test_layout.py",
        "training/simulation/test_rays.py",
        "integration/test_page.py",
        "training/bundling/test_noise.py",
        "clients/test_unity.py",
        "training/models/test_naf.py",
        "streaming/test_session.py",
        "acoustics/test_air.py",
        "test_order.py",
    ]
