//! Why a URDF is refused, and what was assumed where it is not.

use core::fmt;

use super::{MAX_JOINTS, PayloadError};

/// Why a URDF cannot be driven. Each message says what to change.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ArmError {
    /// The text is not a URDF.
    #[error("not a URDF: {message}; expand xacro first and check that the file is complete")]
    Parse {
        /// What the parser said.
        message: String,
    },
    /// Two links, or two joints, share a name.
    #[error("`{name}` is defined twice; links and joints need names of their own")]
    Duplicate {
        /// The name.
        name: String,
    },
    /// A joint names a link that is not defined.
    #[error(
        "joint `{joint}` names the link `{link}`, which is not defined; define it or correct the name"
    )]
    UndefinedLink {
        /// The joint.
        joint: String,
        /// The missing link.
        link: String,
    },
    /// A link is the child of two joints.
    #[error("link `{link}` has two parent joints; a URDF is a tree: remove one")]
    TwoParents {
        /// The link.
        link: String,
    },
    /// Links that are each other's ancestors.
    #[error("link `{link}` does not hang on the root; a URDF is a tree: break the loop of joints")]
    Loop {
        /// A link of the loop, or behind it.
        link: String,
    },
    /// No link without parent, or several.
    #[error("the links form no tree: {} root links ({}); exactly one link may be without parent joint", roots.len(), roots.join(", "))]
    Roots {
        /// The links without parent.
        roots: Vec<String>,
    },
    /// The requested tip is not a link of this URDF.
    #[error("no link `{tip}`; the links are {}", links.join(", "))]
    UnknownTip {
        /// What was asked for.
        tip: String,
        /// What there is.
        links: Vec<String>,
    },
    /// No joint moves the tip.
    #[error("no movable joint between the root and `{tip}`; name another link with --tip")]
    NoMovableJoint {
        /// The tip.
        tip: String,
    },
    /// More joints than the fixed arrays hold.
    #[error(
        "{count} movable joints between the root and `{tip}`, at most {MAX_JOINTS} are supported; choose a nearer --tip or make some of them fixed"
    )]
    TooManyJoints {
        /// The tip.
        tip: String,
        /// The joints on the way to it.
        count: usize,
    },
    /// A joint of more than one degree of freedom on the way to the tip.
    #[error(
        "joint `{joint}` on the way to the tip is {kind}; only revolute, continuous, prismatic and fixed joints are supported"
    )]
    UnsupportedJoint {
        /// The joint.
        joint: String,
        /// Its type.
        kind: &'static str,
    },
    /// An axis of length zero.
    #[error("joint `{joint}` has an axis of length zero; give it a direction")]
    ZeroAxis {
        /// The joint.
        joint: String,
    },
    /// A number that is not finite.
    #[error("{what} of `{name}` is not finite; correct the number")]
    NotFinite {
        /// Which quantity.
        what: &'static str,
        /// Of which link or joint.
        name: String,
    },
    /// A number no arm has, which would overflow where it is squared.
    #[error("{what} of `{name}` is {value:e}, more than {most:e}; correct the number")]
    TooLarge {
        /// Which quantity.
        what: &'static str,
        /// Of which link or joint.
        name: String,
        /// Its value.
        value: f64,
        /// The largest that is read.
        most: f64,
    },
    /// A payload that no load has.
    #[error(transparent)]
    Payload(#[from] PayloadError),
    /// A joint that cannot move.
    #[error(
        "joint `{joint}` has the range [{lower}, {upper}]; give lower < upper, or make it continuous or fixed"
    )]
    EmptyRange {
        /// The joint.
        joint: String,
        /// Lower limit, rad or m.
        lower: f64,
        /// Upper limit, rad or m.
        upper: f64,
    },
    /// A negative limit, damping or friction.
    #[error("{what} of joint `{joint}` is {value}; it must not be negative")]
    Negative {
        /// Which quantity.
        what: &'static str,
        /// The joint.
        joint: String,
        /// Its value.
        value: f64,
    },
    /// A negative mass.
    #[error("link `{link}` has the mass {mass_kg} kg; correct its <inertial>")]
    NegativeMass {
        /// The link.
        link: String,
        /// Its mass, kg.
        mass_kg: f64,
    },
    /// A rotational inertia with a negative principal moment.
    #[error(
        "the inertia of link `{link}` has the principal moment {moment_kg_m2} kg·m²; correct its <inertial>"
    )]
    NegativeInertia {
        /// The link.
        link: String,
        /// The smallest principal moment, kg·m².
        moment_kg_m2: f64,
    },
    /// A joint that would move no mass.
    #[error("joint `{joint}` moves no inertia; give the links beyond it an <inertial>")]
    Massless {
        /// The joint.
        joint: String,
    },
    /// A value was given for a joint that does not exist or lies on the chain.
    #[error("a value was given for `{joint}`, which is not a joint off the chain; remove it")]
    NotOffChain {
        /// The joint.
        joint: String,
    },
    /// A value was given for a joint outside its limits.
    #[error("`{joint}` was to be fixed at {value}, outside its limits [{lower}, {upper}]")]
    FixedOutside {
        /// The joint.
        joint: String,
        /// The value asked for, rad or m.
        value: f64,
        /// Lower limit.
        lower: f64,
        /// Upper limit.
        upper: f64,
    },
}

/// What was assumed while reading a URDF; to be shown to the user.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Notice {
    /// The tip was not named; this link was taken.
    TipChosen {
        /// The link.
        tip: String,
        /// Other links that are ends of the tree.
        others: Vec<String>,
    },
    /// A movable joint does not move the tip (or mimics another): it is fixed, and what hangs on it lumped into the body it is on.
    JointFixed {
        /// The joint.
        joint: String,
        /// Where, rad or m.
        value: f64,
    },
    /// The principal moments break the triangle inequality, so that no mass distribution has them; used as stated.
    TriangleInequality {
        /// The link.
        link: String,
        /// By how much the largest moment exceeds the sum of the others, kg·m².
        excess_kg_m2: f64,
    },
    /// A link has mass but no rotational inertia: a point mass.
    PointMass {
        /// The link.
        link: String,
    },
    /// A link has rotational inertia but no mass.
    InertiaWithoutMass {
        /// The link.
        link: String,
    },
    /// The body behind a joint has no mass; the joint still moves what lies beyond.
    MasslessBody {
        /// The joint.
        joint: String,
    },
    /// A collision shape that is none: ignored.
    ShapeIgnored {
        /// The link.
        link: String,
    },
    /// No effort limit (or zero) is stated: torque is not limited.
    NoEffortLimit {
        /// The joint.
        joint: String,
    },
    /// No velocity limit (or zero) is stated: speed is not limited.
    NoVelocityLimit {
        /// The joint.
        joint: String,
    },
}

impl fmt::Display for Notice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TipChosen { tip, others } if others.is_empty() => {
                write!(f, "tip is `{tip}`")
            }
            Self::TipChosen { tip, others } => write!(
                f,
                "tip is `{tip}` (also possible with --tip: {})",
                others.join(", ")
            ),
            Self::JointFixed { joint, value } => write!(
                f,
                "joint `{joint}` is fixed at {value} and its inertia lumped in"
            ),
            Self::TriangleInequality { link, excess_kg_m2 } => write!(
                f,
                "inertia of `{link}` breaks the triangle inequality by {excess_kg_m2:.2e} kg·m²; used as stated"
            ),
            Self::PointMass { link } => {
                write!(
                    f,
                    "`{link}` has mass but no rotational inertia: a point mass"
                )
            }
            Self::InertiaWithoutMass { link } => {
                write!(f, "`{link}` has rotational inertia but no mass")
            }
            Self::MasslessBody { joint } => write!(f, "the body behind `{joint}` has no mass"),
            Self::ShapeIgnored { link } => {
                write!(
                    f,
                    "a collision shape of `{link}` has no usable size: ignored"
                )
            }
            Self::NoEffortLimit { joint } => {
                write!(f, "`{joint}` states no effort limit: torque is not limited")
            }
            Self::NoVelocityLimit { joint } => {
                write!(
                    f,
                    "`{joint}` states no velocity limit: speed is not limited"
                )
            }
        }
    }
}
