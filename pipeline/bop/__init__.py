"""The only package that reads and writes BOP files: dataset folders, masks, detections and results.

BOP's names stay inside: ``cam_R_m2c`` and ``cam_t_m2c`` become ``T_cam_obj``, ``bbox_xywh`` becomes ``bbox_xyxy``.
Format: Hodan et al., BOP: Benchmark for 6D Object Pose Estimation, ECCV 2018, and BOP's page on the dataset format.
"""
