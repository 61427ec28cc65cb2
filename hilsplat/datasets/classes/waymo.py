"""The 22 classes of Waymo's 3D semantic segmentation.

Source: waymo-research/waymo-open-dataset `protos/segmentation.proto`; 0 is undefined. The benchmark has no
text queries, so the queries are ours: the names in words.
"""

from hilsplat.datasets.classes.class_set import ClassSet

CLASSES: tuple[tuple[int, str, str], ...] = (  # id, name in the protocol buffer, query
    (1, "TYPE_CAR", "car"),
    (2, "TYPE_TRUCK", "truck"),
    (3, "TYPE_BUS", "bus"),
    (4, "TYPE_OTHER_VEHICLE", "other vehicle"),
    (5, "TYPE_MOTORCYCLIST", "motorcyclist"),
    (6, "TYPE_BICYCLIST", "bicyclist"),
    (7, "TYPE_PEDESTRIAN", "pedestrian"),
    (8, "TYPE_SIGN", "sign"),
    (9, "TYPE_TRAFFIC_LIGHT", "traffic light"),
    (10, "TYPE_POLE", "pole"),
    (11, "TYPE_CONSTRUCTION_CONE", "construction cone"),
    (12, "TYPE_BICYCLE", "bicycle"),
    (13, "TYPE_MOTORCYCLE", "motorcycle"),
    (14, "TYPE_BUILDING", "building"),
    (15, "TYPE_VEGETATION", "vegetation"),
    (16, "TYPE_TREE_TRUNK", "tree trunk"),
    (17, "TYPE_CURB", "curb"),
    (18, "TYPE_ROAD", "road"),
    (19, "TYPE_LANE_MARKER", "lane marker"),
    (20, "TYPE_OTHER_GROUND", "other ground"),
    (21, "TYPE_WALKABLE", "walkable ground"),
    (22, "TYPE_SIDEWALK", "sidewalk"),
)

WAYMO_22 = ClassSet(
    "waymo-22",
    "Waymo Open Dataset; queries ours",
    tuple(label for label, _, _ in CLASSES),
    tuple(query for _, _, query in CLASSES),
)
