import time

from maxcon.minimax.clock import processor_time, read_clock


def paused():
    began = read_clock()
    time.sleep(0.1)
    return read_clock() - began


def test_only_work_counts_while_the_processors_time_is_read():
    assert paused() > 0.09
    with processor_time():
        assert paused() < 0.05
        with processor_time():
            assert paused() < 0.05
        assert paused() < 0.05
    assert paused() > 0.09


def test_the_clock_is_put_back_after_an_error():
    try:
        with processor_time():
            raise KeyError
    except KeyError:
        pass
    assert paused() > 0.09
