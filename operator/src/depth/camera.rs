//! A depth camera: what its pixels are.

use std::str::FromStr;

use nalgebra::Vector3;

/// The largest frame, pixels a side.
pub(super) const LARGEST: usize = 4096;

/// The smallest in which a hand can be found.
const SMALLEST: usize = 32;

/// The horizontal focal length of a Kinect's depth camera in widths of its frame (285.6 pixels of 320).
const NOMINAL: f64 = 285.6 / 320.0;

/// Width and height of a frame, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("`{text}`: write WIDTHxHEIGHT, as 640x480");
        let (width, height) = text.split_once('x').ok_or_else(wrong)?;
        let side = |text: &str| {
            let side: usize = text.parse().map_err(|_| wrong())?;
            if (SMALLEST..=LARGEST).contains(&side) {
                Ok(side)
            } else {
                Err(format!(
                    "`{text}`: a side has {SMALLEST} to {LARGEST} pixels"
                ))
            }
        };
        Ok(Self {
            width: side(width)?,
            height: side(height)?,
        })
    }
}

/// Focal lengths and principal point, pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
}

impl FromStr for Intrinsics {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!(
                "`{text}`: write FX,FY,CX,CY in pixels, the focal lengths above 1, as 571,571,320,240"
            )
        };
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
        match numbers.map_err(|_| wrong())?[..] {
            [fx, fy, cx, cy]
                if fx > 1.0 && fy > 1.0 && [fx, fy, cx, cy].iter().all(|v| v.abs() < 1e5) =>
            {
                Ok(Self { fx, fy, cx, cy })
            }
            _ => Err(wrong()),
        }
    }
}

/// Frames of a size in which no hand could be found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("frames of {width} × {height} pixels: a side has {SMALLEST} to {LARGEST}")]
pub struct CameraError {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// A depth camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    size: Size,
    at: Intrinsics,
    unit_m: f64,
    mirror: bool,
}

impl Camera {
    /// One whose counts are `unit_m` (m); without `at` as a Kinect sees. With `mirror` left and right are turned around: a picture
    /// in which the person's right hand is on the left.
    ///
    /// # Errors
    /// [`CameraError`].
    pub fn new(
        size: Size,
        at: Option<Intrinsics>,
        unit_m: f64,
        mirror: bool,
    ) -> Result<Self, CameraError> {
        let Size { width, height } = size;
        let fits = |side| (SMALLEST..=LARGEST).contains(&side);
        if !fits(width) || !fits(height) {
            return Err(CameraError { width, height });
        }
        let nominal = Intrinsics {
            fx: NOMINAL * width as f64,
            fy: NOMINAL * width as f64,
            cx: width as f64 / 2.0,
            cy: height as f64 / 2.0,
        };
        Ok(Self {
            size,
            at: at.unwrap_or(nominal),
            unit_m,
            mirror,
        })
    }

    /// The size of its frames.
    pub fn size(&self) -> Size {
        self.size
    }

    /// What a count is, m.
    pub fn unit_m(&self) -> f64 {
        self.unit_m
    }

    /// Where pixel (`u`, `v`), counted from the top left, is at this depth (m): x right, y up, z away, m.
    pub fn point(&self, u: f64, v: f64, depth_m: f64) -> Vector3<f64> {
        let Intrinsics { fx, fy, cx, cy } = self.at;
        let x = (u - cx) / fx * depth_m;
        let x = if self.mirror { -x } else { x };
        Vector3::new(x, (cy - v) / fy * depth_m, depth_m)
    }

    /// What of a surface square to the camera one pixel sees at this depth (m), m².
    pub fn pixel_m2(&self, depth_m: f64) -> f64 {
        depth_m * depth_m / (self.at.fx * self.at.fy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_intrinsics_are_read_or_refused_with_what_to_write() {
        assert_eq!(
            "640x480".parse(),
            Ok(Size {
                width: 640,
                height: 480
            })
        );
        for bad in ["", "640", "640x", "x480", "16x16", "640x99999", "-640x480"] {
            assert!(bad.parse::<Size>().is_err(), "{bad}");
        }
        for bad in [
            "",
            "571",
            "571,571,320",
            "0,571,320,240",
            "nan,571,320,240",
            "571,571,inf,240",
        ] {
            assert!(bad.parse::<Intrinsics>().is_err(), "{bad}");
        }
        let size = "640x480".parse().unwrap();
        let at = "600,500,300,250".parse().unwrap();
        let camera = Camera::new(size, Some(at), 1e-3, false).unwrap();
        let p = camera.point(360.0, 200.0, 2.0);
        assert!((p - Vector3::new(0.2, 0.2, 2.0)).norm() < 1e-12);
        let mirrored = Camera::new(size, Some(at), 1e-3, true).unwrap();
        assert_eq!(mirrored.point(360.0, 200.0, 2.0).x, -p.x);
        let kinect = Camera::new(size, None, 1e-3, false).unwrap();
        assert!((kinect.point(320.0 + 571.2, 240.0, 1.0).x - 1.0).abs() < 1e-12);
    }
}
