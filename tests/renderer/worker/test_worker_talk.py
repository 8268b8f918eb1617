"""What a worker says of its jobs, and what it keeps to itself."""

import pytest

from photonfarm.renderer.worker.outcomes import JobCounts, WorkerLog
from photonfarm.renderer.worker.settings import WorkerSettings


def settings_of(**changes: object) -> WorkerSettings:
    return WorkerSettings.model_validate({"store": "s", "redis_url": "redis://u:hunter2@h/0", "name": "ada"} | changes)


def test_a_worker_says_a_line_after_its_first_job_and_then_one_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    log = WorkerLog(settings_of(report_s=3600))
    for job in range(5):
        with log.time_job(f"job-{job}"):
            pass
    assert [record.getMessage() for record in caplog.records] == [
        "worker ada: 1 job in 0 s, 0.00 s each; the last was job-0"
    ]
    caplog.clear()
    log = WorkerLog(settings_of(report_s=1e-9))
    for job in range(5):
        with log.time_job(f"job-{job}"):
            pass
    assert len(caplog.records) == 5


def test_what_a_child_tells_of_its_jobs_is_summed_up_and_failures_are_in_it() -> None:
    both = JobCounts.of(JobCounts(3, 1, 96, 10.25).line) + JobCounts(1, 0, 32, 2.0)
    assert both == JobCounts(4, 1, 128, 12.25)
    assert str(both) == "4 jobs done, 1 failed, 128 samples, 12 s"


def test_a_quiet_worker_says_only_why_it_pauses_and_that_once(caplog: pytest.LogCaptureFixture) -> None:
    log = WorkerLog(settings_of(quiet=True))
    with log.time_job("job"):
        pass
    for reason in (None, "the disk is full", "the disk is fuller", None, None):
        log.log_pause(reason)
    assert [record.getMessage() for record in caplog.records] == [
        "worker ada: takes no jobs: the disk is full",
        "worker ada: takes jobs again",
    ]


def test_settings_show_no_password_and_wrong_ones_neither() -> None:
    assert "hunter2" not in repr(settings_of())
    with pytest.raises(ValueError, match="max_jobs") as caught:
        settings_of(max_jobs="hunter2")
    assert "hunter2" not in str(caught.value)
