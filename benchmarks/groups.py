"""Which of the sequences the defaults were chosen on, and which are kept apart."""

from __future__ import annotations

__all__ = ["CHECK", "TUNED"]

#: The defaults were chosen on these twenty: what is measured on them is too good.
TUNED = frozenset(
    {
        "OTB_Bolt2",
        "OTB_Couple",
        "OTB_Crossing",
        "OTB_Dog1",
        "OTB_DragonBaby",
        "OTB_FaceOcc1",
        "OTB_Football1",
        "OTB_Freeman1",
        "OTB_Girl",
        "OTB_Surfer",
        "OTB_Woman",
        "TLD_01_david",
        "TLD_02_jumping",
        "TLD_04_pedestrian2",
        "TLD_06_car",
        "TLD_10_panda",
        "VOT2014_ball",
        "VOT2014_drunk",
        "VOT2014_polarbear",
        "VOT2014_tunnel",
    }
)

#: Nothing is chosen on these fifteen any more. Three of them belong to the first twenty: twelve were never chosen on.
CHECK = frozenset(
    {
        "DTB70_MountainBike6",
        "DUT_Sail",
        "GOT_football",
        "OTB_Crossing",
        "OTB_Deer",
        "OTB_Diving",
        "OTB_Dog",
        "OTB_Freeman1",
        "OTB_Ironman",
        "OTB_Jogging-2",
        "OTB_Man",
        "TIR_airplane",
        "UAV123_wakeboard7",
        "VOT2014_hand1",
        "VOT2014_polarbear",
    }
)
