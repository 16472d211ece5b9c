//! A recording of depth frames: a folder of 16-bit PNG files, one a frame, in the order of the numbers in their names.

use std::fs::{self, File};
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};

use png::{BitDepth, ColorType, Decoder};

use super::Size;
use super::camera::LARGEST;

/// Why a folder is no recording, or a file no frame.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// It cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// Folder or file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// There is no frame.
    #[error("{}: no .png in this folder; a depth recording has one a frame", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// A file is no PNG, or is cut off.
    #[error("{}: {why}; export it again, or leave it out", path.display())]
    Png {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        why: String,
    },
    /// Not one number of 16 bits a pixel.
    #[error("{}: {found} a pixel where depth has one number of 16 bits", path.display())]
    Pixels {
        /// The file.
        path: PathBuf,
        /// What it has.
        found: String,
    },
    /// More pixels than any camera's, which nothing is allocated for.
    #[error("{}: {width} × {height} pixels: a side has {LARGEST} at most", path.display())]
    Large {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// Frames of different sizes.
    #[error(
        "{}: {} × {} pixels where the first frame has {} × {}; one recording has one camera", path.display(), found.width, found.height,
        expected.width, expected.height
    )]
    Size {
        /// The file.
        path: PathBuf,
        /// Its size.
        found: Size,
        /// The first one's.
        expected: Size,
    },
}

/// A recording's frames, in order.
#[derive(Debug, Clone)]
pub struct Folder {
    files: Vec<PathBuf>,
    size: Size,
}

impl Folder {
    /// Lists the frames of the folder and reads the size of the first.
    ///
    /// # Errors
    /// [`FolderError`].
    pub fn open(path: &Path) -> Result<Self, FolderError> {
        let io = |source| FolderError::Io {
            path: path.to_owned(),
            source,
        };
        let mut files = Vec::new();
        for entry in fs::read_dir(path).map_err(io)? {
            let file = entry.map_err(io)?.path();
            if file
                .extension()
                .is_some_and(|e| e.eq_ignore_ascii_case("png"))
            {
                files.push(file);
            }
        }
        files.sort_by_cached_key(|file| number(file));
        let first = files.first().ok_or_else(|| FolderError::Empty {
            path: path.to_owned(),
        })?;
        let (size, _) = read(first)?;
        Ok(Self { files, size })
    }

    /// How many frames there are; at least one.
    #[expect(clippy::len_without_is_empty, reason = "it never is")]
    pub fn len(&self) -> usize {
        self.files.len()
    }

    /// The size of every frame.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Frame `index`: row by row from the top, 0 where nothing was measured.
    ///
    /// # Errors
    /// [`FolderError`], naming the file.
    ///
    /// # Panics
    /// If there are fewer frames.
    pub fn frame(&self, index: usize) -> Result<Vec<u16>, FolderError> {
        let path = &self.files[index];
        let (found, pixels) = read(path)?;
        if found == self.size {
            return Ok(pixels);
        }
        Err(FolderError::Size {
            path: path.clone(),
            found,
            expected: self.size,
        })
    }
}

/// The last number in a file's name, so that 10 comes after 9, and the name.
fn number(file: &Path) -> (Option<u64>, String) {
    let name = file
        .file_stem()
        .map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
    let last = name
        .split(|c: char| !c.is_ascii_digit())
        .rfind(|digits| !digits.is_empty())
        .and_then(|digits| digits.parse().ok());
    (last, name)
}

fn read(path: &Path) -> Result<(Size, Vec<u16>), FolderError> {
    let file = File::open(path).map_err(|source| FolderError::Io {
        path: path.to_owned(),
        source,
    })?;
    decode(path, BufReader::new(file))
}

/// A frame's size and its pixels, row by row from the top, from the PNG in `source`, which is called `path`.
///
/// # Errors
/// [`FolderError`], naming `path`.
pub fn decode(path: &Path, source: impl Read) -> Result<(Size, Vec<u16>), FolderError> {
    let png = |why: png::DecodingError| FolderError::Png {
        path: path.to_owned(),
        why: why.to_string(),
    };
    let mut decoder = Decoder::new(source);
    let (width, height) = decoder.read_header_info().map_err(png)?.size();
    if width.max(height) as usize > LARGEST {
        return Err(FolderError::Large {
            path: path.to_owned(),
            width,
            height,
        });
    }
    let mut reader = decoder.read_info().map_err(png)?;
    let found = reader.output_color_type();
    if found != (ColorType::Grayscale, BitDepth::Sixteen) {
        let (colour, bits) = found;
        return Err(FolderError::Pixels {
            path: path.to_owned(),
            found: format!("{colour:?}, {bits:?} bits"),
        });
    }
    let mut bytes = vec![0; reader.output_buffer_size()];
    let info = reader.next_frame(&mut bytes).map_err(png)?;
    let size = Size {
        width: info.width as usize,
        height: info.height as usize,
    };
    let number = |pair: &[u8]| u16::from_be_bytes([pair[0], pair[1]]);
    Ok((size, bytes.chunks_exact(2).map(number).collect()))
}

#[cfg(test)]
mod tests {
    use std::io::BufWriter;

    use super::*;

    fn write(path: &Path, (width, height): (u32, u32), colour: ColorType, depth: BitDepth) {
        let file = BufWriter::new(File::create(path).unwrap());
        let mut encoder = png::Encoder::new(file, width, height);
        encoder.set_color(colour);
        encoder.set_depth(depth);
        let bytes = if depth == BitDepth::Sixteen { 2 } else { 1 };
        let pixels: Vec<u8> = (0..width * height * bytes).map(|i| i as u8).collect();
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(&pixels).unwrap();
    }

    #[test]
    fn frames_come_in_the_order_of_their_numbers_and_bad_ones_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let open = || Folder::open(dir.path());
        assert!(open().unwrap_err().to_string().contains("no .png"));
        let depth = |name: &str, size| {
            write(
                &dir.path().join(name),
                size,
                ColorType::Grayscale,
                BitDepth::Sixteen,
            );
        };
        depth("depth_10.png", (40, 36));
        depth("depth_9.png", (40, 32));
        let folder = open().unwrap();
        assert_eq!((folder.len(), folder.size().height), (2, 32));
        assert_eq!(folder.frame(0).unwrap()[..2], [0x0001, 0x0203]);
        let error = folder.frame(1).unwrap_err().to_string();
        assert!(
            error.contains("depth_10.png") && error.contains("40 × 36"),
            "{error}"
        );
        write(
            &dir.path().join("1.png"),
            (32, 32),
            ColorType::Grayscale,
            BitDepth::Eight,
        );
        let error = open().unwrap_err().to_string();
        assert!(
            error.contains("1.png") && error.contains("16 bits"),
            "{error}"
        );
        // A header alone, of a picture that would take 32 GB.
        let mut huge = Vec::new();
        let mut encoder = png::Encoder::new(&mut huge, 1 << 17, 1 << 17);
        encoder.set_depth(BitDepth::Sixteen);
        drop(encoder.write_header().unwrap());
        fs::write(dir.path().join("0.png"), huge).unwrap();
        let error = open().unwrap_err().to_string();
        assert!(
            error.contains("0.png") && error.contains("131072 × 131072"),
            "{error}"
        );
        fs::write(dir.path().join("0.png"), b"not a picture").unwrap();
        assert!(matches!(open().unwrap_err(), FolderError::Png { .. }));
    }
}
