"""The sequences that the default settings were tuned on, and those that are held out."""

from __future__ import annotations

__all__ = ["CHECK", "TUNED"]

#: The tuning set: the defaults were tuned on these twenty, so their measures are biased upwards.
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

#: The check set: it is no longer used for tuning. Three of the fifteen are in the tuning set too; twelve never were.
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
