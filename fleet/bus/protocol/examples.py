"""One example of every word on the bus: a job `crate_1` from submission to receipt, and what is said besides."""

from collections.abc import Mapping

import msgspec

from fleet.bus.protocol.auction import (
    Ack,
    Admission,
    Announcement,
    ArmEvent,
    ArmOffer,
    Award,
    Clock,
    ClockRequest,
    JobEstimate,
    JobSpec,
    JobStatus,
    Lease,
    LeaseEntry,
    LeaseRequest,
    PlanQuote,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.cell import Cell, CellArm, CellFixture, CellKind, CellPlace, CellRequest, Limit, PlannedWork
from fleet.bus.protocol.consensus import Bid, Claim, ClaimEntry, ClaimReply, DeniedEntry, GrantedEntry, JobOutcome
from fleet.bus.protocol.history import History, HistoryRequest
from fleet.bus.protocol.messages import DifficultyScores, Info, Refusal, State
from fleet.bus.protocol.operator import (
    Cancel,
    Cleared,
    ClearRequest,
    Controlled,
    ControlRequest,
    Operation,
    ResetReply,
    ResetRequest,
)

CRATE = JobSpec(
    name="crate_1",
    kind="pick_place",
    places=("conveyor", "pallet"),
    repetitions=20,
    payload_kg=1.5,
    due_s=1800.0,
    value=2.0,
)
_ARM, _AUCTIONEER = "arm_0", "auctioneer"
_ROUND, _QUOTE, _AWARD = "auctioneer-17", "arm_0-2-41", "auctioneer-17-crate_1"
_EPOCH = "3f9a0c71"
_CLAIMED, _SPACE = f"{_QUOTE}:crate_1", "5d1c0f7e92ab3486"
_FASTEST = PlanQuote(
    peak_c=51.5,
    gained_k=8.5,
    p_saturation=0.04,
    joint_difficulty=(0.02, 0.31, 0.05, 0.12, 0.01, 0.0, 0.02),
    difficulty=0.53,
    duration_s=212.0,
    finish_in_s=240.5,
    space=_SPACE,
)
_COOLEST = PlanQuote(plan=1, peak_c=48.25, gained_k=5.25, p_saturation=0.01, duration_s=252.0, finish_in_s=280.5)
_OFFER = JobEstimate(job="crate_1", plans=(_FASTEST, _COOLEST))
_DONE = JobStatus(job="crate_1", state="finished", arm=_ARM, award=_AWARD, cycles=20, finished_s=842.5, repetitions=20)
_CELL = Cell(
    auctioneer=_AUCTIONEER,
    scenario="packing",
    places=(
        CellPlace("conveyor", (0.4, 0.2, 0.1), (180.0, 0.0, 0.0), 0.08),
        CellPlace("pallet", (0.4, -0.2, 0.1), (180.0, 0.0, 0.0), 0.08),
    ),
    arms=(
        CellArm(
            _ARM,
            (0.0, 0.0, 0.0),
            (0.0, 0.0, 0.0),
            payload_kg=3.1,
            payload_outstretched_kg=0.2,
            reach_m=0.902,
            works=(PlannedWork("pick_place", CRATE.places, 1.5, plans=4, cycle_s=9.6, dwell_s=0.5),),
        ),
    ),
    kinds=(CellKind("pick_place", 2, "Take the payload from the first place to the second."),),
    limits={"payload_kg": Limit(0.0, 10.0, "kg")},
    warning_c=60.0,
    error_c=75.0,
    jobs_in_message=128,
    fixtures=(CellFixture("table", (0.4, 0.0, -0.05), (0.6, 0.9, 0.1), (0.0, 0.0, 0.0)),),
)
_CANCEL = ControlRequest(request="5f0c2b1e", action=Cancel(job="crate_1"), by="shop floor")

_ALL: tuple[msgspec.Struct, ...] = (
    State(
        arm=_ARM,
        tick=7012,
        time_s=640.0,
        mode="working",
        temp_c=(31.2, 48.9, 35.0, 40.1, 30.2, 29.8, 30.0),
        headroom_k=11.1,
        job="crate_1",
        space=_SPACE,
        busy_s=52.5,
        housing_c=(29.5, 41.0, 32.4, 36.2, 28.8, 28.6, 28.7),
        ambient_c=24.5,
        job_value=2.0,
        job_cycles_left=4,
        job_peak_c=51.0,
        job_p_saturation=0.03,
    ),
    Info(arm=_ARM, joints=7, twin="lstm-vae-3f9a"),
    DifficultyScores(
        arm=_ARM,
        tick=7012,
        time_s=640.0,
        twin="lstm-vae-3f9a",
        jobs=("crate_2", "hold_7"),
        difficulty=(0.61, None),
        p_saturation=(0.07, None),
    ),
    ArmEvent(arm=_ARM, number=58, time_s=611.3, kind="warning", job="crate_1", joint=2, value=60.0),
    QuoteRequest(auction=_ROUND, jobs=(CRATE,), cycles={"crate_1": 3}),
    Quote(
        arm=_ARM,
        auction=_ROUND,
        quote=_QUOTE,
        valid_s=5.0,
        twin="lstm-vae-3f9a",
        time_s=602.0,
        mode="idle",
        headroom_k=14.2,
        capacity=1,
        estimates=(_OFFER,),
        space=(),
    ),
    Award(
        award=_AWARD,
        auction=_ROUND,
        auctioneer=_AUCTIONEER,
        quote=_QUOTE,
        job=CRATE,
        cycles=0,
        lease_s=6.0,
        epoch=_EPOCH,
    ),
    HistoryRequest(),
    History(arm=_ARM, epoch=_EPOCH, finished=(CRATE,), claims={"arm_1": 3000000012}),
    Ack(arm=_ARM, award=_AWARD, accepted=True),
    Bid(
        arm=_ARM,
        number=2_000_000_041,
        time_s=602.0,
        capacity=1,
        estimates=(_OFFER,),
        open_count=2,
        open_jobs=("crate_1", "hold_7"),
    ),
    Claim(
        arm=_ARM,
        number=2_000_000_042,
        entries=(ClaimEntry(_CLAIMED, "crate_1", CRATE.places, cycles=19, phase="finishing", space=_SPACE),),
        outcomes=(
            JobOutcome(job="crate_0", award="arm_0-2-40:crate_0", arm=_ARM, outcome="finished", cycles=8, time_s=590.5),
        ),
        space=(_SPACE,),
    ),
    ClaimReply(
        arm="arm_1",
        number=2_000_000_042,
        lease_s=6.0,
        granted=(GrantedEntry(award=_CLAIMED, cycles=19, may_commit=True),),
        denied=(DeniedEntry(award="arm_0-2-43:hold_7", reason="'arm_2' has 'hold_7'"),),
    ),
    Announcement(auctioneer=_AUCTIONEER, auction=_ROUND, time_s=601.9, jobs=("crate_1",)),
    Result(
        auctioneer=_AUCTIONEER,
        number=32,
        time_s=602.4,
        status=JobStatus(job="crate_1", state="awarded", arm=_ARM, award=_AWARD, repetitions=20),
        auction=_ROUND,
        difficulty=0.53,
        p_saturation=0.04,
        peak_c=51.5,
        offers=(
            ArmOffer(_ARM, "idle", True, PlanQuote(peak_c=51.5, p_saturation=0.04, difficulty=0.53, duration_s=212.0)),
            ArmOffer("arm_1", "working", False, PlanQuote(peak_c=63.0, p_saturation=0.71, difficulty=0.9)),
        ),
    ),
    LeaseRequest(arm=_ARM, entries=(LeaseEntry(award=_AWARD, job="crate_1", cycles=19, phase="finishing"),)),
    Lease(auctioneer=_AUCTIONEER, lease_s=6.0, granted=(_AWARD,), revoked=(), may_commit=(_AWARD,)),
    Report(arm=_ARM, award=_AWARD, job="crate_1", outcome="finished", cycles=20, time_s=842.5),
    Receipt(auctioneer=_AUCTIONEER, award=_AWARD),
    Refusal(reason="Award 'auctioneer-17-crate_1' is of 'crate_1' to 'arm_1', not of 'crate_1' to 'arm_0'."),
    Submission(jobs=(CRATE,), by="shop floor"),
    SubmissionReply(auctioneer=_AUCTIONEER, jobs=(Admission(job="crate_1", accepted=True),), epoch=_EPOCH),
    StatusRequest(jobs=("crate_1",)),
    Status(auctioneer=_AUCTIONEER, time_s=900.0, jobs=(_DONE,), space={"arm_2": ("5d1c0f7e92ab3486",)}, epoch=_EPOCH),
    ClearRequest(arm="arm_2", by="shop floor"),
    Cleared(auctioneer=_AUCTIONEER, arm="arm_2"),
    ResetRequest(by="shop floor"),
    ResetReply(arm=_ARM, changed=True),
    _CANCEL,
    Controlled(
        auctioneer=_AUCTIONEER,
        request=_CANCEL.request,
        changed=True,
        note="The arm ends the cycle in progress and returns it.",
        job=JobStatus(job="crate_1", state="awarded", arm=_ARM, award=_AWARD, cycles=3, repetitions=20, finish_s=842.0),
    ),
    Operation(auctioneer=_AUCTIONEER, time_s=650.0, request=_CANCEL),
    CellRequest(),
    _CELL,
    ClockRequest(),
    Clock(time_s=600.0, speed=60.0, epoch=_EPOCH),
)
EXAMPLES: Mapping[type[msgspec.Struct], msgspec.Struct] = {type(word): word for word in _ALL}
