"""A trained network in onnxruntime alone: `drive` needs neither sgns nor torch.

The rest makes the files, and compares the answers with the simulator's. It takes ten seconds.
Needs: pip install "sgns[export]"
"""

from pathlib import Path

import numpy as np
import onnxruntime


def drive(step_file: str, decode_file: str, path: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force [N] and torque [N m] in every frame (T, 3) of a tool path (T, 7), and the particles at the end (n, 3)."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # a step is too short for more
    step = onnxruntime.InferenceSession(step_file, options)
    decode = onnxruntime.InferenceSession(decode_file, options)
    state = np.zeros((1, step.get_inputs()[0].shape[1]))  # zeros: the bed has not begun
    forces, torques = [], []
    for pose in path:  # the first one is where the tool begins
        state, latent, force, torque = step.run(None, {"state": state, "pose": pose[None]})
        forces.append(force[0])
        torques.append(torque[0])
    (soil,) = decode.run(None, {"latent": latent})
    return np.stack(forces), np.stack(torques), soil[0]


if __name__ == "__main__":
    import mpm_warp
    import sgns
    from sgns.export import export

    simulator = sgns.Simulator.pretrained("excavation")
    if not Path("excavation.onnx").exists():
        export(simulator, "excavation.onnx")  # or: sgns export checkpoint=excavation output=excavation.onnx
    path = mpm_warp.Scene.from_dict(simulator.scene).body_poses()
    force, torque, soil = drive("excavation.onnx", "excavation.decode.onnx", path)

    states = [simulator.reset(path[0]), *map(simulator.step, path[1:])]
    expected = np.stack([state.force for state in states])
    largest = np.abs(force - expected).max()
    print(
        f"{len(path)} frames: force up to {np.abs(force).max():.1f} N, {largest:.1e} N from the simulator's"
    )
    assert largest < 1e-4 * np.abs(expected).max()
    assert np.abs(torque - np.stack([state.torque for state in states])).max() < 1e-2
    assert np.abs(soil - states[-1].soil()).max() < 1e-5

    # For examples/onnx_cpp.
    np.savetxt("path.csv", path, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    loads = np.hstack([force, torque])
    np.savetxt("forces.csv", loads, delimiter=",", header="Fx,Fy,Fz,Tx,Ty,Tz", comments="")
