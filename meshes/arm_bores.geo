// An arm with bearing bores: a bar with rounded ends, solid rings around the bores, of
// quadrilaterals or triangles; the lower half of the mesh is the mirror image of the upper one.
//
// The inboard joint axis lies at the origin, the arm points along +x, the outboard joint axis is
// at (length, 0). The interfaces are the bores' curves. Open this file in Gmsh and change the
// parameters on the left, or pass them with -setnumber, e.g. -setnumber length 0.8.

SetFactory("Built-in");

DefineConstant[
  length  = {1.0,  Min 0, Name "Parameters/1 length (m)"},
  height  = {0.06, Min 0, Name "Parameters/2 height (m)"},
  size    = {height / 12, Min 0, Name "Parameters/3 mesh size (m)"},
  bore    = {height / 6,  Min 0, Name "Parameters/4 bore radius (m)"},
  passive = {height / 8,  Min 0, Name "Parameters/5 solid length at both ends (m)"},
  quads   = {1, Choices{0 = "triangles", 1 = "quadrilaterals"}, Name "Parameters/6 cell shape"}
];

outer = height / 2;    // radius of the rounded ends
ring = bore + passive; // outer radius of the solid rings
rings = (passive > 0);
If (bore <= 0 || ring > 0.95 * outer)
  Error("bore radius %g m and solid ring of %g m do not fit into half the height, %g m", bore, passive, outer);
  Abort;
EndIf
If (height >= length)
  Error("the rounded ends of height %g m overlap within the length %g m", height, length);
  Abort;
EndIf

// Cells along the bar, half across it, on the outward quarter of a bore, through the ring and
// from there to the edge, which is farther away in the corners.
along = Ceil((length - height) / size - 0.01);
across = Ceil(outer / size - 0.01);
quarter = Ceil(Pi / 2 * outer / size - 0.01);
through = Ceil(passive / size - 0.01);
outwards = Ceil(1.2 * (outer - ring) / size - 0.01);

// Upper half. Around each joint four rays: outwards (1), up (2), towards the corner (3) of the
// bar's end, and inwards (4); they meet bore (+0), ring (+4) and edge (+8).
design() = {};
solid() = {};
k = rings ? 4 : 0;
For i In {0 : 1}
  p = 30 * (i + 1);
  x = i * length;
  s = 2 * i - 1; // the direction outwards
  d = Sqrt(0.5);
  Point(p) = {x, 0, 0};
  For j In {0 : k : 4}
    radius = j ? ring : bore;
    Point(p + j + 1) = {x + s * radius, 0, 0};
    Point(p + j + 2) = {x, radius, 0};
    Point(p + j + 3) = {x - s * d * radius, d * radius, 0};
    Point(p + j + 4) = {x - s * radius, 0, 0};
    Circle(p + j + 1) = {p + j + 1, p, p + j + 2};
    Circle(p + j + 2) = {p + j + 2, p, p + j + 3};
    Circle(p + j + 3) = {p + j + 3, p, p + j + 4};
  EndFor
  Point(p + 9) = {x + s * outer, 0, 0};
  Point(p + 10) = {x, outer, 0};
  Point(p + 11) = {x - s * outer, outer, 0};
  Point(p + 12) = {x - s * outer, 0, 0};
  Circle(p + 9) = {p + 9, p, p + 10};
  Line(p + 10) = {p + 10, p + 11};
  Line(p + 11) = {p + 11, p + 12};
  For j In {1 : 4}
    Line(p + 14 + j) = {p + k + j, p + 8 + j};
    Transfinite Curve {p + 14 + j} = outwards + 1;
    If (rings)
      Line(p + 18 + j) = {p + j, p + 4 + j};
      Transfinite Curve {p + 18 + j} = through + 1;
    EndIf
  EndFor
  For j In {1 : 3}
    Transfinite Curve {p + j, p + k + j, p + 8 + j} = (j == 1 ? quarter : across) + 1;
    Curve Loop(p + j) = {p + 14 + j, p + 8 + j, -(p + 15 + j), -(p + k + j)};
    Plane Surface(p + j) = {p + j};
    design() += {p + j};
    If (rings)
      Curve Loop(p + 4 + j) = {p + 18 + j, p + 4 + j, -(p + 19 + j), -(p + j)};
      Plane Surface(p + 4 + j) = {p + 4 + j};
      solid() += {p + 4 + j};
    EndIf
  EndFor
EndFor
Line(1) = {41, 71};
Line(2) = {42, 72};
Transfinite Curve {1, 2} = along + 1;
Curve Loop(1) = {1, 71, -2, -41};
Plane Surface(1) = {1};
design() += {1};

// Its mirror image. Without `Periodic` the triangles would differ.
upper() = {design(), solid()};
lower() = Symmetry {0, 1, 0, 0} { Duplicata { Surface{upper()}; } };
Periodic Surface {lower()} = {upper()} Affine {1, 0, 0, 0,  0, -1, 0, 0,  0, 0, 1, 0,  0, 0, 0, 1};
MeshSize {:} = size;
If (quads)
  Transfinite Surface {upper()};
  Recombine Surface {upper(), lower()};
EndIf

e = 1e-3 * bore;
r = bore + e;
Physical Curve("inboard", 1) = Curve In BoundingBox {-r, -r, -e, r, r, e};
Physical Curve("outboard", 2) = Curve In BoundingBox {length - r, -r, -e, length + r, r, e};
Physical Surface("design", 3) = {design(), lower({0 : 6})};
If (rings)
  Physical Surface("passive", 4) = {solid(), lower({7 : 12})};
EndIf
