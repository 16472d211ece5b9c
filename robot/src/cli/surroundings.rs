//! What the arm carries, what it must keep clear of, and what its tip may touch.

use nalgebra::Vector3;
use telemime_sim::arm::ContactPlane;

use super::Args;
use crate::control::{BarrierConfig, Plane};

/// Four numbers with commas between them.
pub(super) fn four(text: &str) -> Result<[f64; 4], String> {
    let numbers = text.split(',').map(|x| x.trim().parse::<f64>());
    let numbers: Vec<f64> = numbers
        .collect::<Result<_, _>>()
        .map_err(|e| format!("`{text}`: {e}"))?;
    <[f64; 4]>::try_from(numbers).map_err(|_| "write NX,NY,NZ,D: four numbers".to_owned())
}

pub(super) fn barrier(args: &Args) -> anyhow::Result<BarrierConfig> {
    let default = BarrierConfig::default();
    let mut barrier = BarrierConfig {
        self_collision: args.self_collision.unwrap_or(default.self_collision),
        stop_m: args.stop_distance_m.unwrap_or(default.stop_m),
        slow_m: args.slow_distance_m.unwrap_or(default.slow_m),
        ..default
    };
    let floor = args.keep_above;
    let floor = floor.map(|z| [0.0, 0.0, 1.0, z]);
    for [x, y, z, offset_m] in floor.into_iter().chain(args.planes.iter().copied()) {
        barrier = barrier.with_plane(Plane::new(Vector3::new(x, y, z), offset_m)?)?;
    }
    Ok(barrier)
}

pub(super) fn contact(args: &Args) -> anyhow::Result<Option<ContactPlane>> {
    let plane = args.contact_plane;
    let plane = plane.map(|[x, y, z, d]| ContactPlane::new(Vector3::new(x, y, z), d));
    Ok(plane.transpose()?)
}

#[cfg(test)]
mod tests {
    use telemime_endpoint::config::Settings;

    use super::*;

    #[test]
    fn flags_come_before_the_file_and_planes_add_up() {
        let file = "payload = \"1\"\nkeep_above_m = 0.1\nplanes = [[1.0, 0.0, 0.0, -0.4]]\nself_collision = false\n";
        let file: toml::Table = file.parse().unwrap();
        let args = Args {
            payload: Some("2@0,0,0.1".parse().unwrap()),
            keep_above: Some(0.2),
            ..Args::default()
        };
        let args = args.over(file.clone()).unwrap();
        let found = barrier(&args).unwrap();
        assert!(!found.self_collision);
        let planes: Vec<_> = found.planes.into_iter().flatten().collect();
        let tip = Vector3::new(0.6, 0.0, 0.5);
        let heights: Vec<_> = planes.iter().map(|p| p.height_m(&tip)).collect();
        assert_eq!(heights, [0.3, 1.0]);
        assert_eq!(args.payload.unwrap().body().mass_kg, 2.0);
        let carried = Args::default().over(file).unwrap().payload.unwrap();
        assert_eq!(carried.body().mass_kg, 1.0);
        assert!(contact(&args).unwrap().is_none());
        assert_eq!(four("0,0,1,-0.1"), Ok([0.0, 0.0, 1.0, -0.1]));
        assert!(four("0,0,1").is_err() && four("0,0,x,1").is_err());
    }
}
