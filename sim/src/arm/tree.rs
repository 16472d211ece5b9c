//! The tree of links, and which of its ends is the tip.

use std::collections::BTreeMap;

use urdf_rs::{Joint, JointType, Robot};

use super::ArmError;

/// Joints by the links they connect, checked to be one tree.
pub(super) struct Tree<'a> {
    pub(super) robot: &'a Robot,
    pub(super) root: &'a str,
    parents: BTreeMap<&'a str, &'a Joint>,
    children: BTreeMap<&'a str, Vec<&'a Joint>>,
}

impl<'a> Tree<'a> {
    pub(super) fn new(robot: &'a Robot) -> Result<Self, ArmError> {
        let mut children: BTreeMap<&str, Vec<&Joint>> = BTreeMap::new();
        for link in &robot.links {
            if children.insert(&link.name, Vec::new()).is_some() {
                return Err(ArmError::Duplicate {
                    name: link.name.clone(),
                });
            }
        }
        let mut parents = BTreeMap::new();
        let mut names = BTreeMap::new();
        for joint in &robot.joints {
            if names.insert(joint.name.as_str(), ()).is_some() {
                return Err(ArmError::Duplicate {
                    name: joint.name.clone(),
                });
            }
            let undefined = |link: &str| ArmError::UndefinedLink {
                joint: joint.name.clone(),
                link: link.to_owned(),
            };
            if !children.contains_key(joint.child.link.as_str()) {
                return Err(undefined(&joint.child.link));
            }
            children
                .get_mut(joint.parent.link.as_str())
                .ok_or_else(|| undefined(&joint.parent.link))?
                .push(joint);
            if parents.insert(joint.child.link.as_str(), joint).is_some() {
                return Err(ArmError::TwoParents {
                    link: joint.child.link.clone(),
                });
            }
        }
        let roots: Vec<&str> = robot
            .links
            .iter()
            .map(|l| l.name.as_str())
            .filter(|l| !parents.contains_key(l))
            .collect();
        let [root] = roots[..] else {
            return Err(ArmError::Roots {
                roots: roots.into_iter().map(str::to_owned).collect(),
            });
        };
        let tree = Self {
            robot,
            root,
            parents,
            children,
        };
        let reached = tree.walk(|_| true);
        match robot
            .links
            .iter()
            .find(|l| !reached.contains_key(l.name.as_str()))
        {
            Some(l) => Err(ArmError::Loop {
                link: l.name.clone(),
            }),
            None => Ok(tree),
        }
    }

    pub(super) fn children(&self, link: &str) -> &[&'a Joint] {
        self.children.get(link).map_or(&[], Vec::as_slice)
    }

    /// The joints from the root to a link, root first.
    pub(super) fn path(&self, link: &str) -> Vec<&'a Joint> {
        let mut path = Vec::new();
        let mut at = link;
        while let Some(joint) = self.parents.get(at) {
            path.push(*joint);
            at = &joint.parent.link;
        }
        path.reverse();
        path
    }

    /// The link to drive when none is named, and the other candidates: a link called `tool0` or `tcp`, else the end of the
    /// chain with the most moving joints (then the most joints, then the first in the file), not going through a gripper's joints.
    pub(super) fn default_tip(&self) -> (&'a str, Vec<String>) {
        for is_tip in [
            |n: &str| n == "tool0",
            |n: &str| n == "tcp",
            |n: &str| n.ends_with("_tool0"),
            |n: &str| n.ends_with("_tcp"),
        ] {
            let named = self
                .robot
                .links
                .iter()
                .find(|l| is_tip(&l.name) && self.path(&l.name).into_iter().any(moves));
            if let Some(link) = named {
                return (&link.name, Vec::new());
            }
        }
        let mut ends = self.walk(|j| !(moves(j) && is_gripper(j)));
        if ends.values().all(|&(moving, _)| moving == 0) {
            ends = self.walk(|_| true);
        }
        let best = ends.values().copied().max().unwrap_or_default();
        let mut at_best = self
            .robot
            .links
            .iter()
            .map(|l| l.name.as_str())
            .filter(|l| ends.get(l) == Some(&best));
        let tip = at_best.next().unwrap_or(self.root);
        (tip, at_best.map(str::to_owned).collect())
    }

    /// Every link that `pass` lets the walk from the root reach, with (moving joints, joints) on the way.
    fn walk(&self, pass: impl Fn(&Joint) -> bool) -> BTreeMap<&'a str, (usize, usize)> {
        let mut reached = BTreeMap::new();
        let mut open = vec![(self.root, (0, 0))];
        while let Some((link, depth)) = open.pop() {
            reached.insert(link, depth);
            for joint in self.children(link).iter().filter(|j| pass(j)) {
                let deeper = (depth.0 + usize::from(moves(joint)), depth.1 + 1);
                open.push((joint.child.link.as_str(), deeper));
            }
        }
        reached
    }
}

/// Whether a joint is one of the arm's degrees of freedom if it lies on the chain.
pub(super) fn moves(joint: &Joint) -> bool {
    joint.mimic.is_none() && !matches!(joint.joint_type, JointType::Fixed)
}

/// URDF has no notion of a hand: makers' names are all there is to tell a jaw from a wrist.
fn is_gripper(joint: &Joint) -> bool {
    const HAND: [&str; 4] = ["finger", "jaw", "knuckle", "thumb"];
    let (joint, link) = (joint.name.to_lowercase(), joint.child.link.to_lowercase());
    joint.contains("gripper") || HAND.iter().any(|h| joint.contains(h) || link.contains(h))
}
