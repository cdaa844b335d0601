"""The only door to BOP files: dataset folders, masks, detections' geometry and results.

BOP's own names end here: ``cam_R_m2c`` and ``cam_t_m2c`` become ``T_cam_obj``, ``bbox_xywh`` becomes ``bbox_xyxy``.
Format: Hodan et al., BOP: Benchmark for 6D Object Pose Estimation, ECCV 2018, and its page on the dataset format.
"""
